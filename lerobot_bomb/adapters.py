"""What LoRA and other adapters of `peft` change of our policies; LeRobot asks a policy for it."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from huggingface_hub import constants, hf_hub_download, try_to_load_from_cache
from huggingface_hub.errors import RemoteEntryNotFoundError
from torch import Tensor, nn

from lerobot_bomb.hub.checks import ADAPTERS, check_finite
from lerobot_bomb.hub.names import TO_PUBLISH, is_hub_id

PROJECTIONS = "q|k|v|o|gate|up|down"  # of a layer's attention and MLP


def peft_targets(policy: nn.Module, text_model: str, new_parts: Iterable[str]) -> dict[str, Any]:
    """Adapters on every projection of the text model's layers; parts that are new are trained as they are.

    Of ``new_parts``, those that the policy has.
    """
    return {
        "target_modules": rf"backbone\.vlm\.model\.{text_model}\.layers\..*\.({PROJECTIONS})_proj",
        "modules_to_save": [name for name in new_parts if getattr(policy, name, None) is not None],
    }


def frozen_buffers(policy: nn.Module) -> dict[str, Tensor]:
    """Copies of what a checkpoint holds besides parameters; of adapters, none does."""
    parameters = dict(policy.named_parameters(remove_duplicate=False))
    return {name: held.clone() for name, held in policy.state_dict().items() if name not in parameters}


def check_buffers_are_the_bases(policy: nn.Module, base: dict[str, Tensor] | None, advice: str) -> None:
    """Raise a ValueError if the policy was fitted to other data than the checkpoint ``base`` is of.

    Adapters are loaded on that checkpoint again, which would not know of it.
    """
    fitted = frozen_buffers(policy)
    changed = [name for name in fitted if base is not None and not _equal(fitted[name], base.get(name))]
    if changed:
        raise ValueError(
            f"adapters cannot be trained on this checkpoint: {', '.join(changed)} would be fitted to the new "
            f"dataset, but only the checkpoint holds them; {advice}"
        )


def check_base(base: str) -> None:
    """Raise a ValueError unless others can get the checkpoint that adapters are of: its name on the Hub."""
    if not is_hub_id(base):
        raise ValueError(f"the base of these adapters, {base}, is on this machine only; {TO_PUBLISH}")


def check_adapters(path: str, revision: str | None) -> None:
    """Adapters, in a folder or on the Hub, are whole and finite.

    They are safetensors; in their place `peft` would read a pickle.

    Raises:
        FileNotFoundError: there are none.
        ValueError: they are truncated or not finite.
    """
    name = ADAPTERS[1]
    if not Path(path).is_dir():
        try:
            check_finite(Path(hf_hub_download(path, name, revision=revision)))
        except RemoteEntryNotFoundError as error:
            raise FileNotFoundError(f"{name} not found on the HuggingFace Hub in {path}") from error
    elif (Path(path) / name).is_file():
        check_finite(Path(path) / name)
    else:
        raise FileNotFoundError(f"{path} holds no {name}, so it is no whole checkpoint")


def base_commit(base: str, revision: str | None) -> str | None:
    """The commit of the weights that a checkpoint on the Hub was just loaded with; None: it is a folder."""
    if not is_hub_id(base):
        return None
    path = try_to_load_from_cache(base, constants.SAFETENSORS_SINGLE_FILE, revision=revision)
    return Path(path).parent.name if isinstance(path, str) else revision


def _equal(ours: Tensor, theirs: Tensor | None) -> bool:
    return theirs is not None and torch.equal(ours.cpu(), theirs.cpu())
