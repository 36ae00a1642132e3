"""Vector environments whose workers start in under a second and only when they are needed."""

import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from functools import partial
from multiprocessing import parent_process
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv

from lerobot_bomb.results.inference import Query
from lerobot_bomb.results.origin import Evaluation

# LeRobot's rollout passes this option with the reset that starts a new episode; autoreset passes none.
NEW_ROLLOUT_OPTION = "lerobot_new_rollout"


def check_parallel_tasks(number: int) -> None:
    """Raise a ValueError unless LeRobot runs one task after another."""
    if number > 1:
        raise ValueError(
            f"--env.max_parallel_tasks={number} runs tasks in threads, which share the queue and the random "
            "numbers of one policy, and OpenGL draws in the thread that it began in; drop it. To run in "
            f"several processes: lerobot-bomb sweep --workers={number}"
        )


class FreezeAfterEnd(gym.Wrapper):
    """Wrapper that keeps returning the last transition after an episode has ended, through autoreset too.

    LeRobot steps a batch until its slowest episode ends. Without this, the finished ones would be
    reset by the vector env and simulated for nothing. Only a reset that carries ``NEW_ROLLOUT_OPTION``
    or a seed starts a new episode.
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self._last: tuple[Any, dict[str, Any]] | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict]:
        if self._last is not None and seed is None and NEW_ROLLOUT_OPTION not in (options or {}):
            return deepcopy(self._last)
        self._last = None
        return self.env.reset(seed=seed, options=options)

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        if terminated or truncated:
            self._last = (observation, info)
        return observation, float(reward), terminated, truncated, info


@contextmanager
def light_children() -> Iterator[None]:
    """Start processes that do not import the parent's main script.

    multiprocessing re-runs the main script's imports in every child (for ``lerobot-eval``: LeRobot and
    torch, many seconds and hundreds of MB). The env factories live in importable modules, so the
    children do not need that script.
    """
    main = sys.modules["__main__"]
    hidden = {name: main.__dict__.pop(name) for name in ("__file__", "__spec__") if name in main.__dict__}
    main.__spec__ = None
    try:
        yield
    finally:
        main.__dict__.update(hidden)


def _make_frozen(make_one: Callable[[], gym.Env]) -> gym.Env:
    return FreezeAfterEnd(make_one())


def _make_in_worker(make_one: Callable[[], gym.Env]) -> gym.Env:
    """Make an env that Ctrl-C, which reaches every process of a terminal, leaves to its parent to end."""
    if parent_process() is not None:  # gymnasium makes one in the parent, too, to see its spaces
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    return _make_frozen(make_one)


class LazyVectorEnv(VectorEnv):
    """A vector env that starts its workers on first use.

    An evaluation of many conditions creates one of these per condition; only the one in use holds
    processes and OpenGL contexts.

    Args:
        make_ones: one picklable factory per env, of torch-free modules.
        use_async: a worker process per env (`AsyncVectorEnv`); else all in this process.
        context: multiprocessing start method of the workers.
        known_late: number of envs -> keyword arguments of each one's factory that are known only when they
            start.
        on_first_reset: called with the observations of the first reset, in this process.
        last_query: gives the policy's query since its last call, if any; each env's `add_query` gets it
            before a step.
        num_tasks: vector envs of the evaluation, this one among them; each runs as many episodes.
        results_path: file of `--env.results_path` that the envs write to; None: they write none.
    """

    def __init__(
        self,
        make_ones: Sequence[Callable[..., gym.Env]],
        use_async: bool,
        context: str = "forkserver",
        known_late: Callable[[int], Sequence[dict[str, Any]]] = lambda num_envs: [{}] * num_envs,
        on_first_reset: Callable[[Any], None] | None = None,
        last_query: Callable[[], Query | None] = lambda: None,
        num_tasks: int = 1,
        results_path: str | None = None,
    ) -> None:
        probe = make_ones[0]()
        self.num_envs = len(make_ones)
        self.results_path = results_path
        self.single_observation_space = probe.observation_space
        self.single_action_space = probe.action_space
        self.observation_space = gym.vector.utils.batch_space(probe.observation_space, self.num_envs)
        self.action_space = gym.vector.utils.batch_space(probe.action_space, self.num_envs)
        self.metadata = probe.metadata | {"autoreset_mode": AutoresetMode.NEXT_STEP}
        probe.close()
        self._make_ones = make_ones
        self._use_async = use_async
        self._context = context
        self._known_late = known_late
        self._on_first_reset = on_first_reset
        self._last_query = last_query
        self._num_tasks = num_tasks
        self._evaluation: Evaluation | None = None
        self._num_left = 0  # episodes of the evaluation that have not begun
        self._envs: SyncVectorEnv | AsyncVectorEnv | None = None

    def _ensure(self) -> SyncVectorEnv | AsyncVectorEnv:
        """Start the envs unless they run; LeRobot calls this by name to prefetch the next condition."""
        if self._envs is None:
            late = self._known_late(self.num_envs)
            make = _make_in_worker if self._use_async else _make_frozen
            factories = [
                partial(make, partial(make_one, **of_one))
                for make_one, of_one in zip(self._make_ones, late, strict=True)
            ]
            if self._use_async:
                with light_children():
                    self._envs = AsyncVectorEnv(
                        factories, context=self._context, autoreset_mode=AutoresetMode.NEXT_STEP
                    )
            else:
                self._envs = SyncVectorEnv(factories, autoreset_mode=AutoresetMode.NEXT_STEP)
        return self._envs

    @contextmanager
    def _running(self) -> Iterator[SyncVectorEnv | AsyncVectorEnv]:
        """Yield the envs; after an error, which ends a worker, the next use starts all of them again."""
        envs = self._ensure()
        try:
            yield envs
        except BaseException:  # also Ctrl-C
            if self._use_async:
                self.close(terminate=True)
            raise

    def begin_evaluation(self, num_episodes: int, seed: int | None) -> None:
        """Count the next `num_episodes` episodes in an evaluation, which begins with this seed.

        LeRobot fills its last batch, and leaves the surplus out of its rate; the surplus leaves no records.
        """
        self._evaluation = Evaluation(num_episodes * self._num_tasks, seed)
        self._num_left = num_episodes

    def _tell_evaluation(self, envs: SyncVectorEnv | AsyncVectorEnv) -> None:
        """Tell each env which evaluation its next episode belongs to, and whether it counts there."""
        is_over = self._num_left <= 0
        envs.set_attr("evaluation", None if is_over else self._evaluation)
        envs.set_attr("is_counted", [is_over or row < self._num_left for row in range(self.num_envs)])
        self._num_left -= self.num_envs

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start new episodes; autoreset, which starts none, calls the envs themselves."""
        options = {NEW_ROLLOUT_OPTION: True, **(options or {})}
        with self._running() as envs:
            self._tell_evaluation(envs)
            seed = int(seed) if isinstance(seed, np.integer) else seed
            observations, infos = envs.reset(seed=seed, options=options)
        if self._on_first_reset is not None:
            self._on_first_reset(observations)
            self._on_first_reset = None
        self._last_query()  # of other episodes
        return observations, infos

    def step(self, actions: np.ndarray) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        with self._running() as envs:
            if (query := self._last_query()) is not None:
                envs.call("add_query", query)
            return envs.step(actions)

    def call(self, name: str, *args: Any, **kwargs: Any) -> Any:
        with self._running() as envs:
            return envs.call(name, *args, **kwargs)

    def get_attr(self, name: str) -> Any:
        with self._running() as envs:
            return envs.get_attr(name)

    def close(self, **kwargs: Any) -> None:
        if self._envs is not None:
            self._envs.close(**kwargs)
            self._envs = None
