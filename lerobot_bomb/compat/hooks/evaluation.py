"""LeRobot's evaluation with an environment or a policy of ours: corrections of silent errors."""

import logging
import sys
from collections.abc import Callable
from typing import Any

from lerobot_bomb.compat.hooks.replace import replace
from lerobot_bomb.compat.use import is_ours


def check_evaluations(check: Callable[[Any], None]) -> None:
    """Let `check` see each EvalPipelineConfig that is made with an environment of ours.

    An environment is told nothing of LeRobot's --eval flags but the number of copies.
    """
    from lerobot.configs.eval import EvalPipelineConfig  # imports environments and policies

    def around(usual: Callable[[Any], None]) -> Callable[[Any], None]:
        def checked(self: EvalPipelineConfig) -> None:
            usual(self)
            if is_ours(type(self.env)):
                check(self)

        return checked

    replace(EvalPipelineConfig, "__post_init__", around)


def run_tasks_in_turn(is_needed: Callable[[Any], bool]) -> None:
    """Let LeRobot's evaluation of such a policy use no threads, whatever --env.max_parallel_tasks says.

    They would share its queue of actions. Commands that are imported later than this keep the original.
    """

    def around(usual: Callable[..., Any]) -> Callable[..., Any]:
        def evaluate(envs: Any, policy: Any, *args: Any, max_parallel_tasks: int = 1, **options: Any) -> Any:
            if max_parallel_tasks > 1 and is_needed(policy):
                logging.warning(
                    "--env.max_parallel_tasks=%s: tasks are run one after another; threads would share "
                    "this policy's queue of actions. To run in several processes: lerobot-bomb sweep",
                    max_parallel_tasks,
                )
                max_parallel_tasks = 1
            return usual(envs, policy, *args, max_parallel_tasks=max_parallel_tasks, **options)

        return evaluate

    for name in ("lerobot.scripts.lerobot_eval", "lerobot.scripts.lerobot_train", "__main__"):
        module = sys.modules.get(name)
        if hasattr(module, "eval_policy_all"):
            replace(module, "eval_policy_all", around)
