"""Accuracy of predicted numbers under teacher forcing: the true tokens precede each predicted one.

Shapes as in `lerobot_bomb.actions.text`; `M` = N * C + 1 columns, those of all numbers and the end token.
"""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from lerobot_bomb.actions.text import NumberTokens


def counted_numbers(numbers: NumberTokens) -> Tensor:
    """(B, N) bool: the loss counts every digit, so the number is neither hidden nor padding."""
    return (numbers.loss_mask | ~numbers.mask)[..., 1:].all(dim=-1)


def exact_numbers(numbers: NumberTokens, right_BM: Tensor) -> Tensor:
    """(B, M) bool, tokens predicted correctly -> (B, N) bool, all tokens of the number and its end are."""
    right_BNC = right_BM[:, :-1].view_as(numbers.mask)
    # the column after a number is the next one's space or the end; if the loss skips it, it cannot be wrong
    loss_mask_BN = torch.cat(
        [numbers.loss_mask[:, 1:, 0], torch.ones_like(numbers.loss_mask[:, :1, 0])], dim=1
    )
    ends_BN = right_BM[:, numbers.mask.shape[2] :: numbers.mask.shape[2]] | ~loss_mask_BN
    return (right_BNC | ~numbers.mask)[..., 1:].all(dim=-1) & ends_BN


def read_numbers(numbers: NumberTokens, digits_BM: Tensor) -> Tensor:
    """(B, M) predicted digits -> (B, N) the numbers that they form, each as long as the true number."""
    digits_BNW = digits_BM[:, :-1].view_as(numbers.mask)[..., 1:] * numbers.mask[..., 1:]
    place_values_W = 10 ** torch.arange(digits_BNW.shape[-1] - 1, -1, -1, device=digits_BM.device)
    return (digits_BNW * place_values_W).sum(dim=-1)


def means(
    parts: Mapping[str, tuple[Tensor, Tensor]], losses: Tensor, trained_batches: int
) -> dict[str, float]:
    """{name: (values, mask of those that count)} -> {name: mean}, in one transfer from the device.

    A mean of nothing is 0: LeRobot averages over processes in the names' order, so no name may be missing.

    Raises:
        ValueError: ``losses``, which take the same transfer, are not finite.
    """
    sums = [torch.where(counted, values, 0).float().sum() for values, counted in parts.values()]
    counts = [counted.sum().clamp(min=1) for _, counted in parts.values()]
    ratios = torch.stack(sums) / torch.stack(counts)
    *values, loss = torch.cat([ratios, losses.detach().float().sum()[None]]).tolist()
    if not math.isfinite(loss):
        raise ValueError(
            f"the loss is not finite (NaN or infinite) after {trained_batches} batches of training: it has "
            "diverged. Go on from an earlier checkpoint or start again, with a smaller --policy.optimizer_lr "
            "or --policy.dtype=float32"
        )
    return dict(zip(parts, values, strict=True))
