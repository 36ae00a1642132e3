"""Attention masks: which token of a sequence reads which.

Shapes: `B` batch, `L` tokens that read, `X` tokens that are read.
"""

import torch
from torch import Tensor


def causal_reads(readable_BL: Tensor) -> Tensor:
    """(B, L, L) bool: each token (row) reads itself and those before it, as far as they are readable."""
    num_tokens = readable_BL.shape[1]
    return torch.ones_like(readable_BL[0]).expand(num_tokens, -1).tril() & readable_BL[:, None]


def attention_bias(reads_BLX: Tensor, dtype: torch.dtype) -> Tensor:
    """(B, 1, L, X) what is added to the attention logits: nothing where a token (row) reads another."""
    return torch.where(reads_BLX, 0.0, torch.finfo(dtype).min).to(dtype)[:, None]
