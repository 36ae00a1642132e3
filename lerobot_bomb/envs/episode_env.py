"""Base of our environments: episodes from seeds, steps after the end, a record of results at the end.

Simulator workers import this module, so it imports neither torch nor LeRobot.
"""

import operator
from abc import ABC, abstractmethod
from copy import deepcopy
from dataclasses import replace
from typing import Any, Self

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded

from lerobot_bomb.bomb.episode import check_seed
from lerobot_bomb.results.inference import Inference, Query
from lerobot_bomb.results.origin import Evaluation
from lerobot_bomb.results.record import Record
from lerobot_bomb.results.writing import write_record
from lerobot_bomb.smoothness import MIN_ACTIONS, smoothness

type Observation = dict[str, Any]
type Transition = tuple[Observation, float, bool, bool, dict[str, Any]]


class EpisodeEnv[SpecT: Any, RunT, ResultT: Record](gymnasium.Env[Observation, np.ndarray], ABC):
    """Episodes that a frozen spec and a seed determine.

    The seed is that of `reset`, whatever the spec's. Once an episode has ended, `step` changes nothing until
    `reset`, and its reward is 0.
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012
    gripper_dims: tuple[int, ...] = ()  # of an action, which do not count in how smooth it is

    def __init__(self, spec: SpecT, task: str, results_path: str | None, render_mode: str | None):
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode={render_mode!r} is unknown; choose rgb_array or None")
        self.render_mode = render_mode
        self.task = task
        self.task_description = ""
        self._spec = spec
        self._results_path = results_path
        # evaluation of the episode, set by a vector environment
        self.evaluation: Evaluation | None = None
        self.is_counted = True  # else it leaves no record
        self._current_run: RunT | None = None  # set once an episode has been started
        self._seed: int = spec.seed  # of the episode
        self._steps = 0
        self._last_transition: Transition | None = None
        self._actions: list[np.ndarray] = []
        self._queries: list[Query] = []

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start the episode of `seed`, or of a seed that `np_random` draws.

        `options` has no effect; vector environments pass theirs on.
        """
        seed = None if seed is None else _whole(seed)
        super().reset(seed=seed)
        # without a seed not the spec's: a batch shares a spec, and would run one episode
        self._seed = int(self.np_random.integers(2**31)) if seed is None else seed
        self._steps = 0
        self._last_transition = None
        self._actions, self._queries = [], []
        return self._begin(replace(self._spec, seed=self._seed))

    def step(self, action: np.ndarray) -> Transition:
        """Run one control step."""
        run = self._run
        checked = self._check(action)
        if self._last_transition is not None:
            return deepcopy(self._last_transition)
        self._steps += 1
        self._actions.append(np.array(action, dtype=np.float64))
        observation, reward, terminated, truncated, info = self._advance(run, checked)
        if terminated or truncated:
            self._last_transition = deepcopy((observation, 0.0, terminated, truncated, info))
            if self._results_path is not None and self.is_counted:
                write_record(self._results_path, self.episode_result())
        return observation, reward, terminated, truncated, info

    def add_query(self, query: Query) -> None:
        """Add a query of the policy for the next action; without effect once the episode has ended."""
        if self._last_transition is None:
            self._queries.append(query)

    def render(self) -> np.ndarray | None:
        """(H, W, 3) uint8 image for people.

        None, and a warning, in an environment that was made with render_mode=None.
        """
        run = self._run
        if self.render_mode is None:
            gymnasium.logger.warn("render() draws nothing: make the environment with render_mode='rgb_array'")
            return None
        return self._draw_for_people(run)

    def episode_result(self) -> ResultT:
        """Return the result of the episode that has just ended."""
        if self._last_transition is None:
            raise ResetNeeded("the episode has not ended yet")
        j2, j3 = self._smoothness()
        measured = {"action_j2": j2, "action_j3": j3, "inference": Inference.of(self._queries)}
        return replace(self._result(self._run), **measured, evaluation=self.evaluation)

    def _smoothness(self) -> tuple[float | None, float | None]:
        if len(self._actions) < MIN_ACTIONS:
            return None, None
        actions_TD = np.stack(self._actions)
        found = smoothness(actions_TD, np.zeros(len(actions_TD)), exclude=self.gripper_dims)
        return found.j2.mean, found.j3.mean

    def __copy__(self) -> Self:
        return deepcopy(self)  # not two environments on one simulator

    def __getstate__(self) -> dict[str, Any]:
        if self._current_run is not None:
            name = type(self).__name__
            raise TypeError(
                f"a {name} that has been reset cannot be pickled or copied: its simulator and what it draws "
                f"with stay in this process. Pickle one before its first reset, or a factory, as "
                f"functools.partial({name}, spec); the same seed replays the episode"
            )
        return self.__dict__.copy()

    @property
    def _run(self) -> RunT:
        if self._current_run is None:
            raise ResetNeeded("call reset before anything else")
        return self._current_run

    @abstractmethod
    def _begin(self, spec: SpecT) -> tuple[Observation, dict[str, Any]]:
        """Start the spec's episode as `_current_run`; return its first observation and info."""

    def _check(self, action: np.ndarray) -> np.ndarray:
        """Return a copy of an action (D,) as floats; raise a ValueError if it is no action."""
        space, given = self.action_space, np.array(action)
        if given.shape != space.shape:
            raise ValueError(f"action has shape {given.shape}, expected {space.shape}")
        if given.dtype.kind not in "fiub":
            raise ValueError(f"action {given.tolist()} holds {given.dtype}, not numbers")
        with np.errstate(over="ignore"):
            is_finite = np.isfinite(given.astype(space.dtype)).all()
        if not is_finite:
            raise ValueError(f"action {given.tolist()} is not finite in {space.dtype}")
        return given if given.dtype.kind == "f" else given.astype(np.float64)

    @abstractmethod
    def _advance(self, run: RunT, action: np.ndarray) -> Transition:
        """Simulate a step, the `_steps`-th."""

    @abstractmethod
    def _draw_for_people(self, run: RunT) -> np.ndarray:
        """(H, W, 3) uint8 image for people."""

    @abstractmethod
    def _result(self, run: RunT) -> ResultT:
        """Return the result of an episode that has ended."""


def _whole(seed: Any) -> int:
    """Return a seed of any integer type; raise an error for anything else."""
    try:
        number = operator.index(seed)
    except TypeError:
        raise TypeError(f"seed {seed!r} must be a whole number") from None
    check_seed(number)
    return number
