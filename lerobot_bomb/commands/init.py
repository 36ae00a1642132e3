"""``lerobot-bomb init``: a policy before its training, as a checkpoint for a dataset.

LeRobot trains adapters on a checkpoint only: `lerobot-train --policy.path=DIR --peft.method_type=LORA`.
"""

import argparse
import io
from collections.abc import Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass
from typing import Any, cast

import draccus
from draccus.utils import DecodingError
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.random_utils import set_seed

from lerobot_bomb.checkpoints.folder import write_checkpoint
from lerobot_bomb.commands.arguments import path_flag
from lerobot_bomb.data.columns import read_meta
from lerobot_bomb.files import check_new_folder

PREFIX = "--policy."


@dataclass
class _Flags:
    """Flags around the policy's config, so that LeRobot's parser names them as lerobot-train does."""

    policy: PreTrainedConfig


def add_init_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``lerobot-bomb init``; the policy's flags are LeRobot's parser's."""
    parser.set_defaults(rest=[])
    parser.usage = (
        "lerobot-bomb init --policy.type=TYPE --dataset.repo_id=ID --output=DIR (all flags --policy.*)"
    )
    add = parser.add_argument
    add("--dataset.repo_id", dest="repo_id", required=True, help="name of the dataset")
    root = "folder of the dataset (default: LeRobot's, $HF_LEROBOT_HOME/REPO_ID)"
    add("--dataset.root", dest="root", type=path_flag, help=root)
    add("--output", type=path_flag, required=True, help="new folder for the checkpoint")
    add("--seed", type=int, default=1000, help="of what has random weights (default: 1000, lerobot-train's)")


def run_init(args: argparse.Namespace) -> int:
    """Write config, weights and processors with the dataset's features and statistics."""
    check_new_folder("--output", args.output)
    register_third_party_plugins()
    config = parse_policy(args.rest)
    meta = read_meta(args.repo_id, args.root)
    set_seed(args.seed)
    policy = make_policy(config, ds_meta=meta)
    if not any(True for _ in policy.parameters()):
        raise ValueError(f"--policy.type={config.type} has nothing to train")
    pipelines = make_pre_post_processors(config, dataset_stats=cast("Any", meta.stats))
    write_checkpoint(args.output, policy, pipelines)
    print(f"written to {args.output}: train it with lerobot-train --policy.path={args.output}")
    return 0


def parse_policy(flags: Sequence[str]) -> PreTrainedConfig:
    """The config that --policy.* flags describe."""
    others = [flag for flag in flags if flag.startswith("--") and not flag.startswith(PREFIX)]
    if others:
        raise ValueError(f"unrecognized arguments: {' '.join(others)}")
    if not any(flag.split("=")[0] == f"{PREFIX}type" for flag in flags):
        types = ", ".join(sorted(PreTrainedConfig.get_known_choices()))
        raise ValueError(f"{PREFIX}type is missing; choose one of: {types}")
    usage = io.StringIO()  # of argparse: some 400 lines, and the error at their end
    try:
        with redirect_stderr(usage):
            return draccus.parse(_Flags, args=list(flags)).policy
    except SystemExit:
        raise ValueError(usage.getvalue().strip().splitlines()[-1].partition("error: ")[2]) from None
    except DecodingError as error:
        raise ValueError(str(error)) from None
