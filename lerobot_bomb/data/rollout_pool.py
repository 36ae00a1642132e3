"""Episodes of the scripted expert, played in worker processes.

The workers import this module, so it imports neither torch nor LeRobot.
"""

import itertools
import multiprocessing
import signal
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Self

import gymnasium
import numpy as np

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.expert import expert_action
from lerobot_bomb.bomb.observation import AGENT_POS, CAMERAS, PIXELS, RenderOptions, geometry_shapes
from lerobot_bomb.bomb.streams import recorder_noise
from lerobot_bomb.envs.results import EpisodeResult
from lerobot_bomb.envs.rollout import Expert, add_noise, expert_agent, make_env, play


@dataclass(frozen=True)
class RolloutSettings:
    """How to play; with a spec it determines a rollout."""

    render_options: RenderOptions
    noise: float = 0.0  # standard deviation on x, y and z, in units of the largest relative step
    expert: Expert = expert_action


@dataclass(frozen=True)
class Rollout:
    """One episode of T steps. A failed one carries its result only: its arrays are empty."""

    result: EpisodeResult
    states: np.ndarray  # (T, 4) float32, metres
    actions: np.ndarray  # (T, 4) float32, the expert's clean actions
    instructions: list[str]  # T, of each step
    frames: dict[str, np.ndarray]  # camera -> (T, H, W, 3) uint8
    geometry: dict[str, np.ndarray]  # key of `geometry_shapes` -> (T, ...) float32; {} without depth


def collect(env: gymnasium.Env, spec: EpisodeSpec, settings: RolloutSettings) -> Rollout:
    """Play a spec's episode in an `env` of that spec, whatever the seed that the `env` was made with.

    The stored actions are clean, the executed ones carry the noise.
    """
    rng = recorder_noise(spec.seed)
    moments = list(
        play(
            env,
            spec,
            expert_agent(settings.expert),
            disturb=lambda action: add_noise(action, settings.noise, spec.control_mode, rng),
        )
    )
    result = env.get_wrapper_attr("episode_result")()
    if not result.is_success:
        return Rollout(result, np.empty((0, 4), np.float32), np.empty((0, 4), np.float32), [], {}, {})
    observations = [moment.observation for moment in moments[:-1]]
    return Rollout(
        result=result,
        states=np.stack([observation[AGENT_POS] for observation in observations]),
        actions=np.stack([moment.action for moment in moments if moment.action is not None]),
        instructions=[moment.instruction for moment in moments[:-1]],
        frames={camera: np.stack([o[PIXELS][camera] for o in observations]) for camera in CAMERAS},
        geometry={
            key: np.stack([o[key] for o in observations]) for key in geometry_shapes(settings.render_options)
        },
    )


class RolloutPool:
    """Worker processes that play an endless stream of episodes ahead of the writer.

    An iterator over the rollouts in the order of the specs, whatever the number of workers: they take
    turns. Each has a pipe of its own and no thread or lock is shared, so none can hang another.

    Raises:
        RuntimeError: a worker has ended by itself.
    """

    def __init__(self, settings: RolloutSettings, specs: Iterator[EpisodeSpec], num_workers: int) -> None:
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
        for pipe in (*self._pipes, *self._pipes):  # an episode to play and one to go on with
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

    def __next__(self) -> Rollout:
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


def _work(settings: RolloutSettings, pipe: Connection) -> None:
    """A worker's life: specs come, rollouts or an exception go, until the parent ends."""
    worker = _Worker(settings)
    with suppress(EOFError, ConnectionError):
        while True:
            pipe.send(worker.play(pipe.recv()))
    worker.close()


class _Worker:
    """What a worker keeps between episodes: the environment, as long as only the seed changes."""

    def __init__(self, settings: RolloutSettings) -> None:
        self._settings = settings
        self._condition: EpisodeSpec | None = None
        self._env: gymnasium.Env | None = None

    def play(self, spec: EpisodeSpec) -> Rollout | Exception:
        condition = replace(spec, seed=0)
        try:
            if self._env is None or condition != self._condition:
                self.close()
                self._env = make_env(spec, self._settings.render_options)
                self._condition = condition
            return collect(self._env, spec, self._settings)
        except Exception as error:
            return error

    def close(self) -> None:
        if self._env is not None:
            self._env.close()
