"""Adapters: the parts of our policies that LoRA and other methods of `peft` change."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from accelerate import init_empty_weights
from huggingface_hub import constants, hf_hub_download, try_to_load_from_cache
from huggingface_hub.errors import RemoteEntryNotFoundError
from torch import Tensor, nn

from lerobot_bomb.checkpoints.checks import ADAPTERS, check_finite, tensor_shapes
from lerobot_bomb.checkpoints.names import TO_PUBLISH, is_hub_id
from lerobot_bomb.files import read_json

# fields of peft's configs that name files to read or modules to import
NAME_OTHERS = {
    "adapters",
    "cache_file",
    "covariance_file",
    "megatron_config",
    "prompt_tuning_init_state_dict_path",
    "tokenizer_kwargs",
    "tokenizer_name_or_path",
}
PROJECTIONS = "q|k|v|o|gate|up|down"  # of a layer's attention and MLP


def peft_targets(
    policy: nn.Module, text_model: str, new_parts: Iterable[str], others: Iterable[str] = ()
) -> dict[str, Any]:
    """Settings of `peft`: adapters on all projections of the text model's layers; new parts train whole.

    ``others``: patterns of more modules with adapters. ``new_parts`` that the policy lacks are left out.
    """
    text = rf"backbone\.vlm\.model\.{text_model}\.layers\..*\.({PROJECTIONS})_proj"
    return {
        "target_modules": "|".join([text, *others]),
        "modules_to_save": [name for name in new_parts if getattr(policy, name, None) is not None],
    }


def frozen_buffers(policy: nn.Module) -> dict[str, Tensor]:
    """Return copies of everything in a policy's state but its parameters."""
    parameters = dict(policy.named_parameters(remove_duplicate=False))
    return {name: held.clone() for name, held in policy.state_dict().items() if name not in parameters}


def check_buffers_are_the_bases(
    policy: nn.Module, base: dict[str, Tensor] | None, saved: Iterable[str], advice: str
) -> None:
    """Raise a ValueError if the policy's buffers differ from those of the checkpoint ``base``.

    Adapters will be loaded on that checkpoint, which lacks values fitted to other data. Only the modules
    ``saved`` come with the adapters.
    """
    of_saved = tuple(f"{name}." for name in saved)
    fitted = {name: held for name, held in frozen_buffers(policy).items() if not name.startswith(of_saved)}
    changed = [name for name in fitted if base is not None and not _equal(fitted[name], base.get(name))]
    if changed:
        raise ValueError(
            f"adapters cannot be trained on this checkpoint: {', '.join(changed)} would be fitted to the new "
            f"dataset, but only the checkpoint holds them; {advice}"
        )


def check_base(base: str) -> None:
    """Raise a ValueError unless the adapters' base is named by its id on the Hub, where others can get it."""
    if not is_hub_id(base):
        raise ValueError(f"the base of these adapters, {base}, is on this machine only; {TO_PUBLISH}")


def check_adapters(path: str, revision: str | None) -> Path:
    """Check the adapters in a folder or on the Hub, with all that `peft` would read; return their file.

    It must be safetensors; without it `peft` would read a pickle.

    Raises:
        FileNotFoundError: there are none.
        ValueError: they are truncated or not finite, or their config names other files or code.
    """
    config, weights = ADAPTERS
    file = _file(path, weights, revision)
    check_finite(file)
    named = sorted(_named(read_json(_file(path, config, revision))))
    if named:
        raise ValueError(
            f"{path}: {config} sets {named[0]}, by which peft reads other files or imports code; no policy's "
            "adapters need it"
        )
    return file


def _file(path: str, name: str, revision: str | None) -> Path:
    """Return a file of a folder, or of a Hub repository; there it is downloaded if need be."""
    if not Path(path).is_dir():
        try:
            return Path(hf_hub_download(path, name, revision=revision))
        except RemoteEntryNotFoundError as error:
            raise FileNotFoundError(f"{name} not found on the HuggingFace Hub in {path}") from error
    if not (Path(path) / name).is_file():
        raise FileNotFoundError(f"{path} holds no {name}, so it is no whole checkpoint")
    return Path(path) / name


def _named(values: Any) -> set[str]:
    """Return the fields of `NAME_OTHERS` that are set, at any depth."""
    if isinstance(values, list):
        return {name for each in values for name in _named(each)}
    if not isinstance(values, dict):
        return set()
    deeper = {name for each in values.values() for name in _named(each)}
    return deeper | {name for name in NAME_OTHERS & values.keys() if values[name]}


def check_adapters_fit(policy_type: Any, config: Any, path: str, revision: str | None) -> None:
    """Check that adapters fit a policy and none is missing; `peft` would only warn.

    Raises:
        ValueError: they are another policy's, or a part is missing; or `peft` is not installed.
    """
    try:
        import peft  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ValueError("adapters need the package peft: pip install 'lerobot_policy_bomb[lora]'") from error
    file = check_adapters(path, revision)
    with init_empty_weights():  # which takes no memory
        policy = policy_type(config)
    of_adapters = peft.PeftConfig.from_pretrained(path, revision=revision)
    try:
        adapted = peft.get_peft_model(policy, of_adapters, low_cpu_mem_usage=True)
    except ValueError as error:
        raise ValueError(f"{file} is of no {config.type} as config.json describes it: {error}") from None
    expected = peft.get_peft_model_state_dict(adapted, save_embedding_layers=False)
    saved = tensor_shapes(file)
    wrong = sorted(name for name, tensor in expected.items() if saved.get(name) != tuple(tensor.shape))
    if wrong:
        raise ValueError(
            f"{file} is not whole: it lacks {wrong[0]}, or has it in another shape ({len(wrong)} of "
            f"{len(expected)} in all); take it from where it was trained, or train again"
        )


def base_commit(base: str, revision: str | None) -> str | None:
    """Return the commit of the weights that were just loaded from the Hub; None for a folder."""
    if not is_hub_id(base):
        return None
    path = try_to_load_from_cache(base, constants.SAFETENSORS_SINGLE_FILE, revision=revision)
    return Path(path).parent.name if isinstance(path, str) else revision


def _equal(ours: Tensor, theirs: Tensor | None) -> bool:
    return theirs is not None and torch.equal(ours.cpu(), theirs.cpu())
