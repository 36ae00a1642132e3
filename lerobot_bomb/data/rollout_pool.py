"""Episodes of the scripted expert, run in worker processes.

The workers import this module, so it imports neither torch nor LeRobot.
"""

import itertools
import multiprocessing
import signal
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self

import gymnasium
import numpy as np

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.expert import expert_action
from lerobot_bomb.bomb.observation import (
    AGENT_POS,
    CAMERAS,
    ENVIRONMENT_STATE,
    PIXELS,
    RenderOptions,
    geometry_shapes,
)
from lerobot_bomb.bomb.pointing import COLUMNS, Pointing
from lerobot_bomb.bomb.privileged_state import PrivilegedState
from lerobot_bomb.bomb.streams import Stream, generator, recorder_noise
from lerobot_bomb.envs.rollout import Agent, Expert, add_noise, expert_agent, make_env, run_episode
from lerobot_bomb.results.bomb import EpisodeResult

if TYPE_CHECKING:
    from lerobot_bomb.data.blocks import RecordedEpisode


class AnyRollout(Protocol):
    """An episode that was run."""

    @property
    def result(self) -> Any: ...

    @property
    def num_steps(self) -> int:
        """Number of frames to store; 0: the episode failed."""
        ...

    def episode(self) -> "RecordedEpisode":
        """Return the episode that the dataset stores."""
        ...


class Rollouts(Protocol):
    """Settings of an environment's rollouts; with a spec they determine one."""

    max_envs: ClassVar[int]  # that a worker keeps; each holds an OpenGL context

    def make_env(self, spec: Any) -> gymnasium.Env:
        """Make the environment of a spec's episodes."""
        ...

    def collect(self, env: gymnasium.Env, spec: Any, agent: Agent | None = None) -> AnyRollout:
        """Run a spec's episode; return a picklable rollout."""
        ...


@dataclass(frozen=True)
class RolloutSettings:
    """Settings of BOMB's rollouts."""

    max_envs: ClassVar[int] = 8

    render_options: RenderOptions
    noise: float = 0.0  # standard deviation on x, y and z, in units of the largest relative step
    expert: Expert = expert_action
    static: int = 0  # number of scenes instead of an episode; 0: an episode
    pointing: bool = False  # label what the expert points at

    def make_env(self, spec: EpisodeSpec) -> gymnasium.Env:
        return make_env(spec, self.render_options)

    def collect(self, env: gymnasium.Env, spec: EpisodeSpec, agent: Agent | None = None) -> "Rollout":
        return collect(env, spec, self, agent)


@dataclass(frozen=True)
class Rollout:
    """One episode of T steps, or T static scenes. A failed episode has a result only, and T = 0."""

    result: EpisodeResult
    states: np.ndarray  # (T, 4) float32, metres
    actions: np.ndarray  # (T, 4) float32, the expert's clean actions
    instructions: list[str]  # T, of each step
    frames: dict[str, np.ndarray]  # camera -> (T, H, W, 3) uint8
    geometry: dict[str, np.ndarray]  # key of `geometry_shapes` -> (T, ...) float32; {} without depth
    pointing: dict[str, np.ndarray]  # key of `COLUMNS` -> (T, n) float32; {} without labels

    @property
    def num_steps(self) -> int:
        """Number of frames to store."""
        return len(self.instructions)

    def episode(self) -> "RecordedEpisode":
        """Return the episode that the dataset stores."""
        from lerobot_bomb.data.rollout_dataset import rollout_episode  # LeRobot: seconds

        return rollout_episode(self)


def collect(
    env: gymnasium.Env, spec: EpisodeSpec, settings: RolloutSettings, agent: Agent | None = None
) -> Rollout:
    """Run a spec's episode in an `env` that was made for this spec, with any seed.

    The stored actions are the expert's clean ones, the executed ones carry the noise. With an ``agent``,
    which then acts, failed episodes are kept, too.
    """
    if settings.static:
        return collect_static(env, spec, settings)
    rng = recorder_noise(spec.seed)
    moments = list(
        run_episode(
            env,
            spec,
            agent or expert_agent(settings.expert),
            disturb=lambda action: add_noise(action, settings.noise, spec.control_mode, rng),
        )
    )
    result = env.get_wrapper_attr("episode_result")()
    if agent is None and not result.is_success:
        return Rollout(result, np.empty((0, 4), np.float32), np.empty((0, 4), np.float32), [], {}, {}, {})
    shown = moments[:-1]
    actions = [
        settings.expert(moment.state) if agent else moment.action
        for moment in shown
        if moment.action is not None
    ]
    return _rollout(result, [(each.observation, each.instruction) for each in shown], actions, settings)


def collect_static(env: gymnasium.Env, spec: EpisodeSpec, settings: RolloutSettings) -> Rollout:
    """Return static scenes, one for each seed from the spec's on, with the expert's actions.

    The result is of the first one.
    """
    shown, results = [], []
    for seed in range(spec.seed, spec.seed + settings.static):
        observation, result = env.get_wrapper_attr("show_static")(seed)
        shown.append((observation, env.get_wrapper_attr("task_description")))
        results.append(result)
    states = [PrivilegedState.from_vector(observation[ENVIRONMENT_STATE]) for observation, _ in shown]
    return _rollout(results[0], shown, list(map(settings.expert, states)), settings)


def _rollout(
    result: EpisodeResult,
    shown: list[tuple[dict[str, Any], str]],
    actions: list[np.ndarray],
    settings: RolloutSettings,
) -> Rollout:
    observations = [observation for observation, _ in shown]
    return Rollout(
        result=result,
        states=np.stack([observation[AGENT_POS] for observation in observations]),
        actions=np.stack(actions),
        instructions=[instruction for _, instruction in shown],
        frames={camera: np.stack([o[PIXELS][camera] for o in observations]) for camera in CAMERAS},
        geometry={
            key: np.stack([o[key] for o in observations]) for key in geometry_shapes(settings.render_options)
        },
        pointing=_pointing(result.spec, observations) if settings.pointing else {},
    )


def _pointing(spec: EpisodeSpec, observations: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    rng = generator(spec.seed, Stream.POINTING)
    states = [PrivilegedState.from_vector(observation[ENVIRONMENT_STATE]) for observation in observations]
    rows = [Pointing.of(state, rng).columns() for state in states]
    return {name: np.stack([row[name] for row in rows]) for name in COLUMNS}


class RolloutsHere:
    """Episodes that are run in this process, those of another agent if there is one.

    Args:
        settings: of all episodes.
        specs: of each episode.
        first: number of the first episode.
        begin: called with an episode's number, before it.
        agent: acts instead of the expert, who says what it would have done; failed episodes are kept, too.
    """

    def __init__(
        self,
        settings: Rollouts,
        specs: Iterator[Any],
        first: int = 0,
        begin: Callable[[int], None] = lambda number: None,
        agent: Agent | None = None,
    ) -> None:
        self._worker, self._specs, self._begin = _Worker(settings, agent), enumerate(specs, first), begin

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._worker.close()

    def __iter__(self) -> Iterator[AnyRollout]:
        for number, spec in self._specs:
            self._begin(number)
            rollout = self._worker.rollout(spec)
            if isinstance(rollout, Exception):
                raise rollout
            yield rollout


class RolloutPool:
    """Worker processes that run an endless stream of episodes ahead of the writer.

    An iterator over the rollouts in the order of the specs, whatever the number of workers: they take
    turns. Each has a pipe of its own and no thread or lock is shared, so none can hang another.

    Raises:
        RuntimeError: a worker has ended by itself.
    """

    def __init__(self, settings: Rollouts, specs: Iterator[Any], num_workers: int) -> None:
        context = multiprocessing.get_context("spawn")  # a fork of a process with threads may hang
        self._specs = specs
        self._processes: list[SpawnProcess] = []
        self._pipes: list[Connection] = []
        resource_tracker.ensure_running()  # starting it, which the first worker would do, unblocks SIGINT
        # A worker inherits the mask. Ctrl-C in a terminal reaches it too, and would end it with a
        # traceback; the parent ends its workers.
        usual = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            for _ in range(num_workers):
                pipe, workers_end = context.Pipe()
                process = context.Process(target=_work, args=(settings, workers_end), daemon=True)
                process.start()
                workers_end.close()
                self._processes.append(process)
                self._pipes.append(pipe)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, usual)
        self._turns = itertools.cycle(zip(self._processes, self._pipes, strict=True))
        for pipe in (*self._pipes, *self._pipes):  # an episode to run, and one more for when it is done
            self._submit(pipe)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._processes:
            process.kill()
        for process in self._processes:
            process.join()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Any:
        process, pipe = next(self._turns)
        try:
            rollout = pipe.recv()
        except (EOFError, ConnectionError):
            process.join()
            raise RuntimeError(f"a simulator process ended with exit code {process.exitcode}") from None
        if isinstance(rollout, Exception):
            raise rollout
        self._submit(pipe)
        return rollout

    def _submit(self, pipe: Connection) -> None:
        with suppress(ConnectionError):  # the worker has ended; receiving from it says so
            pipe.send(next(self._specs))


def _work(settings: Rollouts, pipe: Connection) -> None:
    """Run a worker: receive specs, send rollouts or an exception, until the parent ends."""
    worker = _Worker(settings)
    with suppress(EOFError, ConnectionError):
        while True:
            pipe.send(worker.rollout(pipe.recv()))
    worker.close()


class _Worker:
    """Worker that keeps an environment of each of the last few conditions between episodes."""

    def __init__(self, settings: Rollouts, agent: Agent | None = None) -> None:
        self._settings, self._agent = settings, agent
        self._envs: dict[Any, gymnasium.Env] = {}

    def rollout(self, spec: Any) -> Any:
        try:
            return self._settings.collect(self._env_of(spec), spec, self._agent)
        except Exception as error:
            return error

    def _env_of(self, spec: Any) -> gymnasium.Env:
        condition = replace(spec, seed=0)
        env = self._envs.pop(condition, None)
        if env is None:
            if len(self._envs) == self._settings.max_envs:
                self._envs.pop(next(iter(self._envs))).close()
            env = self._settings.make_env(spec)
        self._envs[condition] = env  # the last one
        return env

    def close(self) -> None:
        for env in self._envs.values():
            env.close()
