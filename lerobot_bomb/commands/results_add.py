"""``lerobot-bomb results add``: records of LeRobot's own environments, from its eval_info.json."""

import argparse
from pathlib import Path
from typing import Any

from lerobot_bomb.commands.arguments import add_file_and_eval_flags, long_forms
from lerobot_bomb.environments import env_type
from lerobot_bomb.files import read_json
from lerobot_bomb.flags import flag_value
from lerobot_bomb.results.writing import write_record


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_file_and_eval_flags(parser, "of results, which gets a record per episode")


def run(args: argparse.Namespace) -> int:
    """Append the records of an evaluation; the flags are those of its command."""
    flags = long_forms(args.flags)
    if not flag_value(flags, "--output_dir"):
        raise ValueError("--output_dir=... is missing: the folder that lerobot-eval wrote to")
    # LeRobot and torch: seconds
    from lerobot_bomb.checkpoints.identity import identity_of_config
    from lerobot_bomb.compat.own.evaluation import eval_config
    from lerobot_bomb.evaluation.eval_info import EVAL_INFO, results_of

    config = eval_config(flags)
    _check_flags(config)
    path = config.output_dir / EVAL_INFO
    info = read_json(path)
    _check_info(path, info, config.eval.n_episodes)
    policy = identity_of_config(config.policy)
    results = list(results_of(info, config.env, policy, config.seed, config.eval.batch_size))
    for result in results:
        write_record(args.path, result)
    print(f"{args.path}: {len(results)} episodes of {path}")
    return 0


def _check_flags(config: Any) -> None:
    """Raise a ValueError unless the flags give each episode a result of its own."""
    record_type = env_type(config.env.type).record
    if record_type.has_results_path:
        raise ValueError(
            f"--env.type={record_type.env_type}: lerobot-eval writes its records itself, with "
            "--env.results_path=FILE"
        )
    if config.policy is None:
        raise ValueError("--policy.path or --policy.type is missing: the policy that was evaluated")
    if config.seed is None:
        raise ValueError("--seed=null: episodes without a seed cannot be told apart")
    if record_type.starts_by_number and config.eval.batch_size != 1:
        raise ValueError(
            f"--eval.batch_size={config.eval.batch_size}: which initial state an episode of "
            f"--env.type={record_type.env_type} starts in is determined with --eval.batch_size=1 only"
        )


def _check_info(path: Path, info: dict[str, Any], num_episodes: int) -> None:
    """Raise a ValueError unless a file holds an evaluation with this number of episodes of each task."""
    try:
        numbers = {len(task["metrics"]["successes"]) for task in info["per_task"]}
    except (KeyError, TypeError):
        raise ValueError(f"{path} has no episodes in it; name the folder of an evaluation") from None
    if numbers != {num_episodes}:
        found = " and ".join(map(str, sorted(numbers)))
        raise ValueError(f"{path} has {found} episodes of a task, --eval.n_episodes says {num_episodes}")
