"""lerobot-eval in the process of our commands."""

import gc
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from lerobot.policies import PreTrainedPolicy

from lerobot_bomb.compat.hooks.evaluation import tell_of_evaluations


def lerobot_eval_with(flags: Sequence[str], wrap: Callable[[Any, Any], Any]) -> None:
    """Run lerobot-eval with these flags, on its environments as `wrap(config, environments)` returns them."""
    from lerobot.scripts import lerobot_eval

    tell_of_evaluations()
    make_env = lerobot_eval.make_env
    _run_lerobot_eval(flags, make_env=lambda config, **options: wrap(config, make_env(config, **options)))


class KeptPolicy:
    """Runs lerobot-eval several times in one process; keeps a policy as long as the same one is requested.

    Random numbers restart from their state after the policy was built, so an evaluation gives the same
    results as in a process of its own.
    """

    def __init__(self) -> None:
        self._asked: object = None
        self.policy: PreTrainedPolicy | None = None
        self._random_state: dict[str, Any] = {}
        self.env_config: Any = None  # LeRobot's, of the last evaluation
        self.has_begun = False  # whether the last evaluation reached its first episode

    def evaluate(self, flags: Sequence[str], asked: object, first: int = 0) -> None:
        """Run lerobot-eval, which draws no video and runs one task after another.

        An equal `asked` reuses the previous policy, built with the same seed. `first` is the number of an
        episode that is run alone out of a longer evaluation.
        """
        from lerobot.scripts import lerobot_eval
        from lerobot.utils.random_utils import get_rng_state, set_rng_state

        make_env = lerobot_eval.make_env
        make_policy, evaluate_all = lerobot_eval.make_policy, lerobot_eval.eval_policy_all

        def begun(config: Any, **options: Any) -> Any:
            self.env_config = config
            envs = make_env(config, **options)
            if not hasattr(config, "results_path"):  # ours check actions themselves
                for env in (env for of_group in envs.values() for env in of_group.values()):
                    _refuse_not_finite(env)
                    _start_with(env, first)
            return envs

        def kept(**options: Any) -> PreTrainedPolicy:
            if self.policy is None or self._asked != asked:
                self.policy = None  # the process then holds one at a time
                gc.collect()
                self.policy, self._asked = make_policy(**options), asked
                self._random_state = get_rng_state()
            set_rng_state(self._random_state)
            return self.policy

        def without_videos(*args: Any, **options: Any) -> dict[str, Any]:
            self.has_begun = True
            options |= {"max_episodes_rendered": 0, "videos_dir": None, "max_parallel_tasks": 1}
            return evaluate_all(*args, **options)

        self.has_begun = False
        replaced = {"make_env": begun, "make_policy": kept, "eval_policy_all": without_videos}
        _run_lerobot_eval(flags, init_logging=lambda: None, **replaced)


def _refuse_not_finite(env: Any) -> None:
    """Let a vector env raise an ArithmeticError for a non-finite action; LeRobot's may end the process."""
    step = env.step

    def checked(actions: np.ndarray) -> Any:
        if not np.isfinite(actions).all():
            raise ArithmeticError("an action of the policy is not finite")
        return step(actions)

    env.step = checked


def _start_with(env: Any, number: int) -> None:
    """Let LeRobot's LIBERO start in the initial state of this number; by itself it begins with the first."""
    if any(hasattr(each.unwrapped, "init_state_id") for each in getattr(env, "envs", ())):
        env.set_attr("init_state_id", [number + row for row in range(env.num_envs)])


def eval_config(flags: Sequence[str]) -> Any:
    """Read LeRobot's EvalPipelineConfig from flags, as lerobot-eval does.

    Raises:
        SystemExit: the flags are wrong; LeRobot's parser has said why.
    """
    from lerobot.configs import parser
    from lerobot.configs.eval import EvalPipelineConfig
    from lerobot.utils.import_utils import register_third_party_plugins

    def read(config: EvalPipelineConfig) -> EvalPipelineConfig:
        return config

    register_third_party_plugins()
    with _argv("lerobot-eval", flags):
        read_flags: Any = parser.wrap()(read)
        return read_flags()


def _run_lerobot_eval(flags: Sequence[str], **replaced: Any) -> None:
    """Run lerobot-eval in this process, with functions of it replaced by name."""
    from lerobot.scripts import lerobot_eval

    usual = {name: getattr(lerobot_eval, name) for name in replaced}
    try:
        for name, function in replaced.items():
            setattr(lerobot_eval, name, function)
        with _argv("lerobot-eval", flags):
            lerobot_eval.main()
    finally:
        for name, function in usual.items():
            setattr(lerobot_eval, name, function)


@contextmanager
def _argv(command: str, flags: Sequence[str]) -> Iterator[None]:
    """Set sys.argv, which LeRobot's parser reads in several places."""
    usual, sys.argv = sys.argv, [command, *flags]
    try:
        yield
    finally:
        sys.argv = usual
