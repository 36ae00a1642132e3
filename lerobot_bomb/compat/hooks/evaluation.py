"""LeRobot's evaluation with an environment or a policy of ours: corrections of silent errors."""

import logging
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping
from inspect import signature
from pathlib import Path
from types import ModuleType
from typing import Any

from lerobot_bomb.compat.hooks.replace import replace
from lerobot_bomb.compat.use import is_ours

AGAIN = "The same command runs all of them again; lerobot-bomb sweep resumes"
BEGIN = "begin_evaluation"  # method of our vector environments
_STEPS: list[int] = []  # of the training that this process evaluated at, by `note_training_steps`


def check_evaluations(check: Callable[[Any], None]) -> None:
    """Let `check` see each EvalPipelineConfig that is made with an environment of ours.

    LeRobot tells an environment nothing of its --eval flags but the number of copies.
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
    """Let LeRobot evaluate without threads, whatever --env.max_parallel_tasks says, if `is_needed(policy)`.

    Threads would share the policy's queue of actions. Commands that are imported later keep the original.
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

    for module in _loaded_with("eval_policy_all"):
        replace(module, "eval_policy_all", around)


def tell_of_evaluations() -> None:
    """Let LeRobot's evaluation tell an environment how many episodes it counts, and film each to its end.

    LeRobot films the start and each step, and then cuts off the last image, which names the outcome. At the
    end, it names the command that shows the results. All are for environments with `begin_evaluation`; others
    are evaluated as ever.
    """

    def telling(usual: Callable[..., Any]) -> Callable[..., Any]:
        def eval_policy(*args: Any, **options: Any) -> Any:
            given = signature(usual).bind(*args, **options).arguments
            if begin_evaluation := getattr(given["env"], BEGIN, None):
                begin_evaluation(given["n_episodes"], given.get("start_seed"))
            try:
                return usual(*args, **options)
            except KeyboardInterrupt:
                path = getattr(given["env"], "results_path", None)
                if path is not None and Path(path).is_file():
                    logging.info("%s has the episodes that ended. %s", path, AGAIN)
                raise

        return eval_policy

    def filming(usual: Callable[..., Any]) -> Callable[..., Any]:
        def rollout(*args: Any, **options: Any) -> Any:
            env = options["env"] if "env" in options else args[0]
            if options.get("render_callback") is not None and hasattr(env, BEGIN):
                options["render_callback"] = _but_first(options["render_callback"])
            return usual(*args, **options)

        return rollout

    def closing(usual: Callable[..., Any]) -> Callable[..., Any]:
        def close_envs(envs: Any) -> None:
            usual(envs)
            for path in _results_paths(envs):
                logging.info("next: lerobot-bomb results %s", shlex.quote(path))

        return close_envs

    for module in _loaded_with("eval_main"):  # where all are looked up
        replace(module, "eval_policy", telling)
        replace(module, "rollout", filming)
        replace(module, "close_envs", closing)


def note_training_steps() -> None:
    """Let `evaluated_step` know the step of each evaluation during a training.

    LeRobot's training names an evaluation's videos by it, before it makes the environments.
    """

    def around(usual: Callable[..., str]) -> Callable[..., str]:
        def noted(step: int, *args: Any, **options: Any) -> str:
            _STEPS[:] = [step]
            return usual(step, *args, **options)

        return noted

    for module in _loaded_with("update_policy"):  # those that train
        replace(module, "get_step_identifier", around)


def evaluated_step() -> int | None:
    """Return the step at which the training in this process is evaluated; None if it names none."""
    return _STEPS[0] if _STEPS else None


def _results_paths(envs: Mapping[str, Mapping[int, Any]]) -> list[str]:
    """Return the files to which environments of ours have written results."""
    paths = [getattr(env, "results_path", None) for of_group in envs.values() for env in of_group.values()]
    return [path for path in dict.fromkeys(paths) if path is not None]


def _but_first(call: Callable[[Any], None]) -> Callable[[Any], None]:
    """Return `call` as a function whose first call does nothing."""
    is_first = True

    def later(argument: Any) -> None:
        nonlocal is_first
        if not is_first:
            call(argument)
        is_first = False

    return later


def _loaded_with(name: str) -> Iterator[ModuleType]:
    """Yield the loaded modules of LeRobot's evaluating commands that hold a function of this name."""
    names = ("lerobot.scripts.lerobot_eval", "lerobot.scripts.lerobot_train", "__main__")
    for module in map(sys.modules.get, names):
        if module is not None and hasattr(module, name):
            yield module
