"""A policy before its training, as a checkpoint."""

import io
from collections.abc import Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import draccus
from draccus.utils import DecodingError
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.random_utils import set_seed

from lerobot_bomb.checkpoints.folder import write_checkpoint
from lerobot_bomb.data.columns import read_meta

PREFIX = "--policy."


@dataclass
class _Flags:
    """Flags around the policy's config, so that LeRobot's parser names them as lerobot-train does."""

    policy: PreTrainedConfig


def write_initial(flags: Sequence[str], repo_id: str, root: Path | None, output: Path, seed: int) -> None:
    """Write the policy that --policy.* flags describe, with a dataset's features and statistics.

    Raises:
        ValueError: a flag is wrong, or the policy has nothing to train.
    """
    register_third_party_plugins()
    config = parse_policy(flags)
    meta = read_meta(repo_id, root)
    set_seed(seed)
    policy = make_policy(config, ds_meta=meta)
    if not any(True for _ in policy.parameters()):
        raise ValueError(f"--policy.type={config.type} has nothing to train")
    pipelines = make_pre_post_processors(config, dataset_stats=cast("Any", meta.stats))
    write_checkpoint(output, policy, pipelines)


def parse_policy(flags: Sequence[str]) -> PreTrainedConfig:
    """Parse the config that --policy.* flags describe."""
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
