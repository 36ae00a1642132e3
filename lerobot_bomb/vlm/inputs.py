"""Reading of a batch, with errors that name the fault."""

import torch
from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS, OBS_STATE
from torch import Tensor

from lerobot_bomb.actions.text import TokenRows
from lerobot_bomb.finite import require_finite_batch

# (B, S) bool, tokens of the instruction that no other token reads; their positions stay theirs
OBS_LANGUAGE_HIDDEN = f"{OBS_LANGUAGE_TOKENS}.hidden"
# on CUDA, instructions are padded to a multiple of this, so that they share captured graphs
TEXT_COLUMNS = 16


def read_tensor(batch: dict[str, Tensor], key: str, policy_type: str, device: torch.device) -> Tensor:
    """Return a batch's value; raise if absent, on another device or, on the CPU, not finite or in range.

    On CUDA the host would have to wait for the last check; `TaskStep` makes it before.
    """
    if key not in batch:
        raise KeyError(f"{policy_type} needs {key!r}; the batch has {sorted(batch)}")
    if batch[key].device != device:
        raise ValueError(f"batch[{key!r}] is on {batch[key].device}, the policy on {device}")
    if device.type == "cpu":
        require_finite_batch({key: batch[key]}, batch)
    return batch[key]


def read_image(batch: dict[str, Tensor], key: str, policy_type: str, device: torch.device) -> Tensor:
    """Read images (B, 3, H, W), floats in [0, 1]."""
    image_B3HW = read_tensor(batch, key, policy_type, device)
    if image_B3HW.ndim != 4 or image_B3HW.shape[1] != 3 or not image_B3HW.is_floating_point():
        raise ValueError(
            f"batch[{key!r}] is {image_B3HW.dtype} of shape {tuple(image_B3HW.shape)}; expected floats "
            f"in [0, 1] of shape (batch, 3, height, width)"
        )
    return image_B3HW


def read_state(batch: dict[str, Tensor], policy_type: str, device: torch.device, num_dims: int) -> Tensor:
    """Read the robot's normalised state, (B, S)."""
    state_BS = read_tensor(batch, OBS_STATE, policy_type, device)
    if state_BS.ndim != 2 or state_BS.shape[1] != num_dims:
        raise ValueError(
            f"batch[{OBS_STATE!r}] has shape {tuple(state_BS.shape)}; expected (batch, {num_dims}), as the "
            f"policy's config says"
        )
    return state_BS


def read_task(batch: dict[str, Tensor], policy_type: str, device: torch.device) -> TokenRows:
    """Read the instructions' tokens, with padding."""
    ids_BL, mask_BL = (
        read_tensor(batch, key, policy_type, device)
        for key in (OBS_LANGUAGE_TOKENS, OBS_LANGUAGE_ATTENTION_MASK)
    )
    hidden_BL = None
    if OBS_LANGUAGE_HIDDEN in batch:
        hidden_BL = read_tensor(batch, OBS_LANGUAGE_HIDDEN, policy_type, device)
    task = TokenRows(ids_BL, mask_BL.bool(), hidden_BL)
    return task.rounded(TEXT_COLUMNS) if ids_BL.is_cuda else task


def read_actions(
    batch: dict[str, Tensor], key: str, policy_type: str, device: torch.device, shape: tuple[int, int]
) -> Tensor:
    """Read actions (B, T, D) of ``shape`` (T, D); one action may come as (B, D), one dimension as (B, T)."""
    actions_BTD = read_tensor(batch, key, policy_type, device)
    if actions_BTD.ndim == 2 and 1 in shape and actions_BTD.shape[1] == max(shape):
        actions_BTD = actions_BTD.unflatten(1, shape)
    if actions_BTD.ndim != 3 or actions_BTD.shape[1:] != shape:
        raise ValueError(
            f"batch[{key!r}] has shape {tuple(actions_BTD.shape)}; expected (batch, {shape[0]}, {shape[1]}) "
            f"(--policy.chunk_size, action dims)"
        )
    return actions_BTD
