"""Attention masks: which token of a sequence attends to which.

Shapes: `B` batch, `L` tokens that attend, `X` tokens that are attended to.
"""

import torch
from torch import Tensor


def causal_mask(attention_mask_BL: Tensor) -> Tensor:
    """(B, L) bool -> (B, L, L): a token (row) attends to itself and those before it that are in the mask."""
    column_L = torch.arange(attention_mask_BL.shape[1], device=attention_mask_BL.device)
    causal_LL = column_L[:, None] >= column_L
    return causal_LL & attention_mask_BL[:, None]


def attention_bias(attention_mask_BLX: Tensor, dtype: torch.dtype) -> Tensor:
    """(B, 1, L, X) added to the attention logits: 0 where the mask is True, else the type's lowest number."""
    return torch.where(attention_mask_BLX, 0.0, torch.finfo(dtype).min).to(dtype)[:, None]
