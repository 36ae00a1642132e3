"""Read a checkpoint's folder as LeRobot's commands do, and write one."""

from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import torch
from draccus.utils import DecodingError
from lerobot.configs import PreTrainedConfig
from lerobot.policies import PreTrainedPolicy, make_pre_post_processors
from lerobot.processor import (
    DataProcessorPipeline,
    PolicyAction,
    PolicyProcessorPipeline,
    UnnormalizerProcessorStep,
)
from lerobot.utils.device_utils import get_safe_torch_device, is_torch_device_available
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_bomb.actions.relative import Statistics
from lerobot_bomb.checkpoints.checks import PROCESSORS, processor_files
from lerobot_bomb.checkpoints.names import CONFIG, check_checkpoint
from lerobot_bomb.checkpoints.processor_files import check_states
from lerobot_bomb.files import written_whole

Preprocessor = PolicyProcessorPipeline[dict[str, Any], dict[str, Any]]
Postprocessor = PolicyProcessorPipeline[PolicyAction, PolicyAction]


def read_config(path: Path, device: str | None, flags: Sequence[str] = ()) -> PreTrainedConfig:
    """Read the config in the folder `pretrained_model`; `device` None keeps the checkpoint's own.

    `flags` change other values: "--n_action_steps=4".

    Raises:
        ValueError: the folder holds no checkpoint, or this machine has no such device.
    """
    check_checkpoint(path)
    if device is not None and not is_torch_device_available(device):
        raise ValueError(f"the device {device} is not available on this machine; cpu is")
    register_third_party_plugins()
    config = parse_config(path, device, flags)
    config.pretrained_path = path
    return config


def parse_config(path: Path, device: str | None, flags: Sequence[str] = ()) -> PreTrainedConfig:
    """Read the config in a folder; its type must be registered.

    Raises:
        ValueError: it is truncated, of a newer version or of an unknown type.
    """
    overrides = [*flags] if device is None else [*flags, f"--device={device}"]
    try:
        return PreTrainedConfig.from_pretrained(path, cli_overrides=overrides)
    except DecodingError as error:
        raise ValueError(f"{path / CONFIG}: {error}") from None


def load_processors(config: PreTrainedConfig) -> tuple[Preprocessor, Postprocessor]:
    """Load the processors of a checkpoint, on the config's device.

    Raises:
        ValueError: they are incomplete, or not data only (`lerobot_bomb.checkpoints.processor_files`).
    """
    folder = Path(str(config.pretrained_path))
    for name in PROCESSORS:
        processor_files(folder, name)
    processors = make_pre_post_processors(
        policy_cfg=config,
        pretrained_path=str(folder),
        preprocessor_overrides={"device_processor": {"device": str(config.device)}},
    )
    for name, processor in zip(PROCESSORS, processors, strict=True):
        check_states(processor.steps, str(folder / name), complete=True)
    return processors


def saved_statistics(config: PreTrainedConfig) -> dict[str, Statistics]:
    """Return the statistics that a checkpoint's processors normalise by; {feature: {statistic: values}}."""
    processor = DataProcessorPipeline.from_pretrained(
        str(config.pretrained_path), config_filename=PROCESSORS[1], revision=config.pretrained_revision
    )
    (step,) = (step for step in processor.steps if isinstance(step, UnnormalizerProcessorStep))
    statistics: dict[str, Statistics] = {}
    for name, values in step.state_dict().items():
        feature, _, statistic = name.rpartition(".")
        statistics.setdefault(feature, {})[statistic] = values.numpy()
    return statistics


def write_checkpoint(
    path: Path, policy: PreTrainedPolicy, processors: Iterable[PolicyProcessorPipeline[Any, Any]]
) -> None:
    """Write config, weights and processors to a new folder, which appears when complete."""
    with written_whole(path) as (folder,):
        policy.save_pretrained(folder)
        for processor in processors:
            processor.save_pretrained(folder)


def autocast(config: PreTrainedConfig) -> AbstractContextManager:
    """Return the context for the precision in which LeRobot's commands call the policy."""
    return torch.autocast(get_safe_torch_device(str(config.device)).type) if config.use_amp else nullcontext()
