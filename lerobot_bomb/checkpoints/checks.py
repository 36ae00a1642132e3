"""Checks that a checkpoint's folder is whole and works on another machine."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from accelerate import init_empty_weights
from lerobot.configs import PreTrainedConfig
from lerobot.policies import PreTrainedPolicy
from lerobot.policies.factory import get_policy_class
from lerobot.utils.constants import POLICY_POSTPROCESSOR_DEFAULT_NAME, POLICY_PREPROCESSOR_DEFAULT_NAME
from lerobot.utils.import_utils import register_third_party_plugins
from safetensors import SafetensorError, safe_open
from torch import Tensor

from lerobot_bomb.checkpoints.environment import ConfigWithEnvironment
from lerobot_bomb.checkpoints.names import CONFIG, WEIGHTS
from lerobot_bomb.checkpoints.processor_files import (
    check_float_statistics,
    refuse_link_out,
    saved_type,
    state_files,
)
from lerobot_bomb.files import read_json
from lerobot_bomb.finite import is_finite, require_finite

ADAPTERS = ("adapter_config.json", "adapter_model.safetensors")
PROCESSORS = (f"{POLICY_PREPROCESSOR_DEFAULT_NAME}.json", f"{POLICY_POSTPROCESSOR_DEFAULT_NAME}.json")

# a grid's edges: rows of fewer bins than the finest coordinate's end with inf
FILLED_WITH_INF = "grids.edges"

type Shapes = dict[str, tuple[int, ...]]


def checkpoint_files(folder: Path) -> list[str]:
    """Return the names of the files that make up a checkpoint, each whole.

    Raises:
        ValueError: one is missing, truncated or of another format.
    """
    if not folder.is_dir():
        raise ValueError(f"{folder} is no folder; give the one that lerobot-train names pretrained_model")
    has_adapters = (folder / CONFIG).is_file() and read_json(folder / CONFIG).get("use_peft")
    weights = ADAPTERS if has_adapters else (WEIGHTS,)
    for name in (CONFIG, *PROCESSORS, *weights):
        if not (folder / name).is_file():
            raise ValueError(
                f"{folder} holds no {name}, so it is no checkpoint of a policy; give the folder that "
                "lerobot-train names pretrained_model"
            )
    tensor_shapes(folder / weights[-1])
    before, after = (processor_files(folder, processor) for processor in PROCESSORS)
    return [CONFIG, *weights, *before, *after]


def processor_files(folder: Path, processor: str) -> list[str]:
    """Return the names of a processor's files, each whole and data only; none is loaded.

    Raises:
        ValueError: one is missing, truncated, not finite, not of floats or of another format, or a step is
            not registered.
    """
    register_third_party_plugins()  # their steps
    content = read_json(folder / processor)
    states = state_files(content, str(folder / processor), saved_type(folder / CONFIG))
    for name in states:
        if not (folder / name).is_file():
            raise ValueError(f"{folder} holds no {name}, which its {processor} needs")
        refuse_link_out(folder / name)
        check_finite(folder / name)
    check_float_statistics(content, folder)
    return [processor, *states]


def tensor_shapes(path: Path) -> Shapes:
    """Return the shapes of all tensors in a file, from its header.

    Raises:
        ValueError: the file is truncated or of another format.
    """
    try:
        with safe_open(path, "pt") as tensors:
            return {name: tuple(tensors.get_slice(name).get_shape()) for name in tensors.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise ValueError(f"{path} is truncated or no safetensors file: {error}") from None


def check_finite(path: Path) -> None:
    """Check that a safetensors file holds no NaN or infinite values; one tensor at a time is in memory.

    Raises:
        ValueError: a tensor is not finite; the message names it, how many of its values are not, and where.
            Or the file is truncated or of another format.
    """
    advice = "; take a checkpoint from before, or train again"
    try:
        with safe_open(path, "pt") as tensors:
            for name in tensors.keys():  # noqa: SIM118
                values = tensors.get_tensor(name)
                if not is_finite(values):
                    values = _without_filling(values) if name.endswith(FILLED_WITH_INF) else values
                    require_finite(values, f"{path}: {name}", advice)
    except SafetensorError as error:
        raise ValueError(f"{path} is truncated or no safetensors file: {error}") from None


def _without_filling(edges: Tensor) -> Tensor:
    """Edges (C, E) -> the same with 0 in place of each row's trailing inf, but for its first two edges."""
    is_filling = (edges == torch.inf).flip(1).cumprod(dim=1).flip(1).bool()
    is_filling[:, :2] = False
    return edges.masked_fill(is_filling, 0)


def policy_class(folder: Path) -> type[PreTrainedPolicy]:
    """Return the policy class of a checkpoint of one of our types.

    Raises:
        ValueError: the type is not one of ours.
    """
    name = read_json(folder / CONFIG).get("type")
    known = PreTrainedConfig.get_known_choices()
    found = get_policy_class(name) if isinstance(name, str) and name in known else None
    if found is None or not hasattr(found, "method"):
        raise ValueError(
            f"{folder / CONFIG}: the type {name!r} is not one that lerobot-bomb pushes; "
            "lerobot-train --policy.push_to_hub=true pushes LeRobot's own"
        )
    return found


def check_config(folder: Path, config: PreTrainedConfig) -> None:
    """Check that a checkpoint needs nothing but its own files, and no code.

    Raises:
        ValueError: it needs more; the message names what.
    """
    for field, value in vars(config).items():
        if field.endswith("_config") and _names_code(value):
            raise ValueError(f"{folder / CONFIG}: its {field} names code to run, which no checkpoint needs")
    missing = config.missing_parts() if isinstance(config, ConfigWithEnvironment) else None
    if missing is not None:
        raise ValueError(f"{folder / CONFIG} does not hold {missing}")


def _names_code(values: Any, key: str = "") -> bool:
    """Return True if a transformers config asks, at any depth, for remote code or a kernel of the Hub."""
    if isinstance(values, dict):
        return any(_names_code(each, name) for name, each in values.items())
    if isinstance(values, list):
        return any(_names_code(each, key) for each in values)
    if key in ("attn_implementation", "_attn_implementation"):
        return "/" in str(values)
    return key == "trust_remote_code" and bool(values)


def check_weights(folder: Path, config: PreTrainedConfig, policy_type: type[PreTrainedPolicy]) -> None:
    """Check that weights fit the config's policy, by name and shape, without loading them.

    Raises:
        ValueError: names the first tensor that is missing, not known, or of another shape.
    """
    with init_empty_weights():
        policy = policy_type(config)
    check_tensors(folder / WEIGHTS, policy)


def check_tensors(path: Path, policy: PreTrainedPolicy) -> list[str]:
    """Check that a file's weights fit a policy, by name and shape; return the names of those that it needs.

    A policy may do without parts of a file (``may_skip``) and have parts of its own that the file lacks as a
    whole (``may_lack``): names of modules.

    Raises:
        ValueError: the file is truncated; or names a tensor that is missing, unknown or of another shape.
    """
    may_skip, may_lack = getattr(policy, "may_skip", ()), getattr(policy, "may_lack", ())
    saved = {name: shape for name, shape in tensor_shapes(path).items() if not _is_of(name, may_skip)}
    brought = [part for part in may_lack if not holds_module(path, part)]
    expected = {
        name: tuple(tensor.shape) for name, tensor in policy.state_dict().items() if not _is_of(name, brought)
    }
    start = f"{path} is not of the {policy.config.type} that {CONFIG} describes: "
    missing = sorted(expected.keys() - saved.keys() - _tied(policy, set(saved)))
    if missing:
        raise ValueError(f"{start}it lacks {missing[0]} ({len(missing)} in all)")
    unknown = sorted(saved.keys() - expected.keys())
    if unknown:
        raise ValueError(f"{start}it has {unknown[0]} ({len(unknown)} in all)")
    for name, shape in saved.items():
        if shape != expected[name]:
            raise ValueError(f"{start}{name} has shape {shape}, not {expected[name]}")
    return [*saved]


def holds_module(path: Path, module: str) -> bool:
    """Return True if a file of weights exists and has tensors of a module."""
    return path.is_file() and any(_is_of(name, [module]) for name in tensor_shapes(path))


def _is_of(name: str, modules: Iterable[str]) -> bool:
    """Return True if a tensor belongs to one of the modules, by its name."""
    return any(name.startswith(f"{module}.") for module in modules)


def _tied(policy: PreTrainedPolicy, saved: set[str]) -> set[str]:
    """Return the names of tensors that are tied to a saved one."""
    found = set()
    for prefix, module in policy.named_modules():
        for pair in (getattr(module, "all_tied_weights_keys", None) or {}).items():
            names = {f"{prefix}.{name}" for name in pair}
            if names & saved:
                found |= names
    return found
