"""Command that trained a checkpoint."""

import json
from dataclasses import MISSING, Field, fields
from typing import Any

import draccus
from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig

from lerobot_bomb.checkpoints.names import has_local_path
from lerobot_bomb.hub.markdown import command

# a policy's fields that the code fills in, or that say where it runs and is published
NOT_FLAGS = {
    "input_features",
    "output_features",
    "vlm_config",
    "depth_config",
    "prompt_tokens",
    "grid_params",
    "trained_with",
    "trained_batches",
    "environment",
    "ignore_environment",
    "use_peft",
    "package_version",
    "action_feature_names",
    "device",
    "repo_id",
    "private",
    "tags",
    "license",
    "push_to_hub",
    "pretrained_path",
    "pretrained_revision",
}


def train_command(
    config: PreTrainedConfig, training: TrainPipelineConfig | None, start: str | None, dataset_id: str
) -> str:
    """Return the command of a checkpoint's last training, without local paths.

    `start`: the checkpoint that it started from; None: it started from the type's own weights.
    """
    first = f"--policy.type={config.type}" if start is None else f"--policy.path={start}"
    flags = [first, *_flags_of(config, "policy"), f"--dataset.repo_id={dataset_id}"]
    if training is not None:
        if training.dataset.episodes is not None:
            flags.append(f"--dataset.episodes={_text(training.dataset.episodes)}")
        flags += [f"--{name}={_text(getattr(training, name))}" for name in ("batch_size", "steps", "seed")]
        flags += peft_flags(training)
    return command("lerobot-train", *flags, f"--output_dir=outputs/{config.type}")


def peft_flags(training: TrainPipelineConfig | None) -> list[str]:
    """Return the flags of a training of adapters; none for another training."""
    if training is None or training.peft is None:
        return []
    method = f"--peft.method_type={training.peft.method_type}"
    return list(dict.fromkeys([method, *_flags_of(training.peft, "peft")]))


def _flags_of(config: Any, group: str) -> list[str]:
    """Return the flags of the fields that differ from their defaults."""
    flags = []
    for each in fields(config):
        value = draccus.encode(getattr(config, each.name))
        if each.name in NOT_FLAGS or not each.init or value == _default(each) or has_local_path(value):
            continue
        flags.append(f"--{group}.{each.name}={_text(value)}")
    return flags


def _default(field: Field) -> Any:
    value = field.default if field.default_factory is MISSING else field.default_factory()
    return None if value is MISSING else draccus.encode(value)


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
