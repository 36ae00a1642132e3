"""``lerobot-bomb results actions``: lerobot-eval that also writes the executed actions.

Shapes: `B` environments, `T` actions of an episode, `D` action dims.
"""

import argparse
import math
import sys
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from lerobot_bomb.commands.arguments import add_file_and_eval_flags, long_forms
from lerobot_bomb.files import check_writable

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv
    from lerobot.envs import EnvConfig

type Envs = dict[str, dict[int, VectorEnv]]  # {group: {task id: vector env}}, as LeRobot has them


class LoggedVectorEnv:
    """A vector env that logs the actions of each episode when it ends; all else is the env's own.

    LeRobot's ``--eval.recording`` fails on a second batch and keeps no seeds; a processor sees no end of an
    episode.

    Args:
        env: a VectorEnv of B environments, or one of LeRobot's lazy ones, which are no VectorEnv.
        log: called with an episode's seed and the actions (T, D) that `env` was given.
    """

    def __init__(self, env: Any, log: Callable[[int, np.ndarray], None]) -> None:
        self._env = env
        self._log = log
        self._seeds: list[int] = []
        self._actions: list[np.ndarray] = []  # of all steps since the reset, (B, D) each
        self._is_running_B = np.zeros(0, dtype=bool)
        self._max_steps = 0
        self._num_left = math.inf  # episodes that LeRobot counts and that have not begun

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)

    def begin_evaluation(self, num_episodes: int, seed: int | None) -> None:
        """Log only the next `num_episodes` episodes; others just fill LeRobot's last batch."""
        self._num_left = num_episodes
        if begin := getattr(self._env, "begin_evaluation", None):
            begin(num_episodes, seed)

    def reset(self, *, seed: Sequence[int] | None = None, **options: Any) -> tuple[Any, dict[str, Any]]:
        if seed is None:
            raise ValueError("--seed=null: episodes without a seed cannot be told apart; give a number")
        start = self._env.reset(seed=list(seed), **options)
        self._seeds, self._actions = list(seed), []
        self._is_running_B = np.arange(len(seed)) < self._num_left
        self._num_left -= len(seed)
        self._max_steps = self._env.call("_max_episode_steps")[0]
        return start

    def step(self, actions_BD: np.ndarray) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        self._actions.append(actions_BD.copy())
        observation, reward, terminated_B, truncated_B, info = self._env.step(actions_BD)
        is_last = len(self._actions) == self._max_steps  # LeRobot ends an episode then, whatever the env says
        ends_B = self._is_running_B & (terminated_B | truncated_B | is_last)
        for i in np.flatnonzero(ends_B):
            self._log(self._seeds[i], np.stack(self._actions)[:, i])
        self._is_running_B &= ~ends_B
        return observation, reward, terminated_B, truncated_B, info


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_file_and_eval_flags(parser, "new file: a JSON line per finished episode")


def run(args: argparse.Namespace) -> int:
    """Evaluate; show a failure of lerobot-eval with its traceback, as lerobot-eval does."""
    if args.path.exists():
        raise ValueError(f"{args.path} exists already, and a file holds one evaluation; name another")
    check_writable("FILE", args.path)
    # LeRobot and torch: seconds
    from draccus.utils import DecodingError

    from lerobot_bomb.compat.own.evaluation import lerobot_eval_with

    try:
        lerobot_eval_with(long_forms(args.flags), partial(logged, args.path))
    except DecodingError:
        raise  # one line
    except Exception:
        traceback.print_exc()
        return 1
    print(args.path, file=sys.stderr)
    return 0


def logged(path: Path, config: "EnvConfig", envs: Envs) -> Envs:
    """Wrap the environments so that their executed actions go to a file."""
    return {
        group: {
            task_id: cast("VectorEnv", LoggedVectorEnv(env, _log_to(path, group, task_id, config.fps)))
            for task_id, env in of_group.items()
        }
        for group, of_group in envs.items()
    }


def _log_to(path: Path, group: str, task_id: int, fps: float) -> Callable[[int, np.ndarray], None]:
    from lerobot_bomb.evaluation.executed import append_episode

    return lambda seed, actions_TD: append_episode(path, group, task_id, seed, fps, actions_TD)
