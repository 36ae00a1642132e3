"""Checks that a checkpoint's processors are data: they name known steps, which have all they need.

LeRobot imports and calls whatever `class` a step names, before it checks the result.
"""

import logging
import os
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from lerobot.configs import FeatureType, NormalizationMode, PreTrainedConfig
from lerobot.processor import (
    NormalizerProcessorStep,
    ProcessorStep,
    ProcessorStepRegistry,
    UnnormalizerProcessorStep,
)
from lerobot.utils.constants import POLICY_POSTPROCESSOR_DEFAULT_NAME, POLICY_PREPROCESSOR_DEFAULT_NAME
from safetensors import safe_open

from lerobot_bomb.actions.relative import BOUND_STATISTICS, CENTRE_AND_DISTANCE
from lerobot_bomb.compat.hooks.policies import built_policies
from lerobot_bomb.compat.hooks.processors import check_processors_before_use
from lerobot_bomb.files import read_json
from lerobot_bomb.finite import require_finite
from lerobot_bomb.vlm.task_tokenizer import TaskTokenizerStep, without_geometry

logger = logging.getLogger(__name__)

STATE_SUFFIX = ".safetensors"

# steps of LeRobot that run code of the repository or folder that their config names -> the types that need
# them, whose own models run such code too
RUN_CODE = {
    "action_tokenizer_processor": ("pi0_fast",),
    "groot_n1_7_vlm_encode_v1": ("groot",),
    "reward_classifier_processor": (),
    "robometer_encoder": ("robometer",),
    "topreward_encoder": ("topreward",),
}
# the only step that LeRobot saves by its class and has not loaded before
SARM_STEP = "lerobot.rewards.sarm.processor_sarm.SARMEncodingProcessorStep"
# steps of LeRobot that read files of the repository or folder that their config names
READ_OTHERS = {"tokenizer_processor", "eo1_qwen_processor", "molmoact2_pack_inputs"}
# name of a processor of our types -> the steps that it has, at least, beside the one that reads the task
NEEDED = {
    POLICY_PREPROCESSOR_DEFAULT_NAME: {"normalizer_processor"},
    POLICY_POSTPROCESSOR_DEFAULT_NAME: {"unnormalizer_processor"},
}
# steps that hold statistics
NORMALIZERS = {step for steps in NEEDED.values() for step in steps}
# statistics that a mode normalises by; the identity has none
STATISTICS = {**BOUND_STATISTICS, NormalizationMode.MEAN_STD: CENTRE_AND_DISTANCE}


def saved_type(config_file: Path) -> object:
    """Return the type in a checkpoint's config.json; None if it cannot be read, which its reader reports."""
    try:
        return read_json(config_file).get("type")
    except (OSError, ValueError):
        return None


def _is_our_type(policy_type: object) -> bool:
    """Return True if a type, as config.json names it, is ours: its checkpoints hold all that they need."""
    known = PreTrainedConfig.get_known_choices()
    return isinstance(policy_type, str) and hasattr(known.get(policy_type), "package_version")


def state_files(content: Mapping[str, Any], where: str, policy_type: object) -> list[str]:
    """Check a processor's JSON, and return the names of its state files; no step is built.

    Plugins must be registered before. `where` is the file, for errors; `policy_type` is the checkpoint's.

    Raises:
        ValueError: a step is not registered, would run code, or its state lies elsewhere.
    """
    steps = content.get("steps")
    if not isinstance(steps, list) or not all(isinstance(step, dict) for step in steps):
        raise ValueError(f"{where} holds no list of steps")
    name = content.get("name", "")
    if not isinstance(name, str) or (_is_our_type(policy_type) and name not in NEEDED):
        raise ValueError(f"{where}: its name {name!r} is none of {sorted(NEEDED)}")
    for step in steps:
        _check_step(step, where, policy_type)
    if _is_our_type(policy_type):
        missing = sorted(_needed(name, policy_type) - {step["registry_name"] for step in steps})
        if missing:
            raise ValueError(f"{where} lacks the step {missing[0]!r} of a {policy_type}")
    return [step["state_file"] for step in steps if "state_file" in step]


def _needed(processor: str, policy_type: object) -> set[str]:
    if processor != POLICY_PREPROCESSOR_DEFAULT_NAME:
        return NEEDED[processor]
    config: Any = PreTrainedConfig.get_known_choices()[str(policy_type)]
    return NEEDED[processor] | {config.TASK_STEP}


def _check_step(step: Mapping[str, Any], where: str, policy_type: object) -> None:
    name = step.get("registry_name")
    if "registry_name" not in step:
        name = _name_of_class(step.get("class"), where, policy_type)
    elif not isinstance(name, str) or name not in ProcessorStepRegistry.list():
        raise ValueError(f"{where}: no step {name!r} is registered here; install the plugin that has it")
    if name in RUN_CODE and policy_type not in RUN_CODE[name]:
        raise ValueError(
            f"{where}: the step {name!r} runs code of what its config names ({step.get('config')}), which no "
            f"{policy_type or 'checkpoint'} needs"
        )
    if name in READ_OTHERS and _is_our_type(policy_type):
        raise ValueError(f"{where}: the step {name!r} reads other files, which no {policy_type} needs")
    if not isinstance(step.get("config", {}), dict):
        raise ValueError(f"{where}: the config of its step {name!r} is no JSON object")
    if "state_file" in step:
        _check_state_file(step["state_file"], where)
    if "artifacts" in step:
        _check_artifacts(step["artifacts"], f"{where}: artifacts of its step {name!r}", policy_type)


def _name_of_class(path: object, where: str, policy_type: object) -> str | None:
    """Return the registered name, if any, of a step given by the path of a class in a loaded module.

    Raises:
        ValueError: it is no step, or the checkpoint is of our types, whose steps are all registered.
    """
    if isinstance(path, str) and not _is_our_type(policy_type):
        module, _, name = path.rpartition(".")
        if path == SARM_STEP:
            import_module(module)
        found = getattr(sys.modules.get(module), name, None)
        if isinstance(found, type) and issubclass(found, ProcessorStep):
            return getattr(found, "_registry_name", None)
    raise ValueError(
        f"{where}: its step {path!r} is named by the path of a class, which may be any code; a step is "
        "registered by its plugin (ProcessorStepRegistry.register) and named by registry_name"
    )


def _check_state_file(name: object, where: str) -> None:
    if not isinstance(name, str) or not name.endswith(STATE_SUFFIX) or {"/", "\\", "\0"} & set(name):
        raise ValueError(
            f"{where}: state_file={name!r} is no name of a {STATE_SUFFIX} file in the checkpoint's folder"
        )


def refuse_link_out(file: Path) -> None:
    """Raise a ValueError if a file is a link out of its folder, except to the blobs of the Hub's cache."""
    folder = Path(os.path.realpath(file.parent))
    allowed = [folder, *([folder.parents[1] / "blobs"] if folder.parent.name == "snapshots" else [])]
    target = Path(os.path.realpath(file))
    if not any(target.is_relative_to(each) for each in allowed):
        raise ValueError(f"{file} is a link to {target}, out of the checkpoint's folder: put the file there")


def _check_artifacts(artifacts: object, what: str, policy_type: object) -> None:
    """Check the folders that take the place of values of a step's config (LeRobot 0.6.2)."""
    if _is_our_type(policy_type):
        raise ValueError(f"{what} are other files, which no {policy_type} needs")
    paths = list(artifacts.values()) if isinstance(artifacts, dict) else [artifacts]
    for path in paths:
        if not isinstance(path, str) or Path(path).is_absolute() or ".." in Path(path).parts:
            raise ValueError(f"{what}: {path!r} is no path in the checkpoint's folder")


def check_saved_processors() -> None:
    """Check, from now on, every processor that this process loads, also in LeRobot's commands."""

    def check(content: dict[str, Any], where: str, config: Path) -> None:
        for name in state_files(content, where, saved_type(config)):
            refuse_link_out(config.parent / name)

    check_processors_before_use(check, _check_loaded, _statistics_to_set)


def _statistics_to_set(of_dataset: dict[str, Any]) -> dict[str, Any] | None:
    """Return the statistics that the processors of the policy just loaded get; None: they keep theirs."""
    built = built_policies()
    config: Any = built[-1].config if built else None
    keeps = getattr(config, "keep_statistics", None)  # None: no policy of ours
    if keeps is False and config.trained_batches:
        _warn_of_new_statistics(config.pretrained_path)
    if keeps is None:
        return of_dataset
    return None if keeps else without_geometry(of_dataset)


@cache
def _warn_of_new_statistics(checkpoint: Path | None) -> None:
    logger.warning(
        "%s will be trained with the statistics of the new dataset, so that its first actions have other "
        "sizes; --policy.keep_statistics=true keeps its own",
        checkpoint,
    )


def _check_loaded(steps: Sequence[Any], where: str, config_file: Path) -> None:
    is_of_us = _is_our_type(saved_type(config_file))
    check_states(steps, where, complete=is_of_us)
    for name in NEEDED if is_of_us else ():
        path = config_file.with_name(f"{name}.json")
        if path.is_file():
            check_float_statistics(read_json(path), path.parent)


def check_float_statistics(content: Mapping[str, Any], folder: Path) -> None:
    """Check that a processor's saved statistics are floats; loading would hide that they were rounded.

    Raises:
        ValueError: names the file and the first statistic that is not a float.
    """
    for step in content["steps"]:
        path = folder / step.get("state_file", "")
        if step.get("registry_name") not in NORMALIZERS or not path.is_file():
            continue
        with safe_open(path, "pt") as tensors:
            for name in tensors.keys():  # noqa: SIM118
                dtype = tensors.get_tensor(name).dtype
                if not dtype.is_floating_point:
                    raise ValueError(
                        f"{path}: {name} is {dtype}, not a float: the checkpoint was trained on whole "
                        "numbers, to which LeRobot rounded all statistics; train again"
                    )


def check_states(steps: Sequence[Any], where: str, complete: bool) -> None:
    """Check that the steps' loaded states are finite where used and, if `complete`, hold all that is used.

    Raises:
        ValueError: names the statistic that is missing, of another shape or not finite.
    """
    for step in steps:
        if isinstance(step, NormalizerProcessorStep | UnnormalizerProcessorStep):
            _check_statistics(step, where, complete)
        elif isinstance(step, TaskTokenizerStep) and step.tokenizer is None:
            raise ValueError(
                f"{where}: its step bomb_task_tokenizer names no state_file, so it has no tokenizer"
            )


def _check_statistics(step: Any, where: str, complete: bool) -> None:
    held = step.state_dict()
    for key, feature in step.features.items():
        chosen = step.normalize_observation_keys
        if chosen is not None and key not in chosen and feature.type is not FeatureType.ACTION:
            continue
        mode = step.norm_map.get(feature.type, NormalizationMode.IDENTITY)
        for name in STATISTICS.get(mode, ()):
            tensor = held.get(f"{key}.{name}")
            if tensor is None:
                # images and arrays without statistics are left as they are
                if complete and (len(feature.shape) == 1 or any(f.startswith(f"{key}.") for f in held)):
                    raise ValueError(f"{where}: its statistics lack {key}.{name}, which {mode.value} needs")
                continue
            require_finite(tensor, f"{where}: {key}.{name}")
            if complete and len(feature.shape) == 1 and tuple(tensor.shape) != tuple(feature.shape):
                raise ValueError(
                    f"{where}: {key}.{name} has shape {tuple(tensor.shape)}, not {tuple(feature.shape)}"
                )
