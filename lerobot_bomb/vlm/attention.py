"""Attention masks, that is, which token of a sequence attends to which; and bfloat16 on a CPU.

Shapes: `B` batch, `L` tokens that attend, `X` tokens that are attended to.
"""

import logging
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import scaled_dot_product_attention
from torch.overrides import TorchFunctionMode

logger = logging.getLogger(__name__)


class Float32Attention(TorchFunctionMode):
    """Context in which torch's fused attention is computed in float32, whatever it is given.

    In bfloat16, its gradients take four to ten times as long on a CPU.
    """

    def __torch_function__(
        self, func: Callable, types: Any, args: tuple = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        if func is not scaled_dot_product_attention:
            return func(*args, **kwargs)
        exact_kwargs = {name: _float32(value) for name, value in kwargs.items()}
        with torch.autocast("cpu", enabled=False):
            attended = func(*map(_float32, args), **exact_kwargs)
        return attended.to(args[0].dtype)


def warn_if_bfloat16_is_slow() -> None:
    """Warn of bfloat16 on a CPU that has no instructions for it."""
    if not is_bfloat16_fast():
        logger.warning(
            "--policy.dtype=bfloat16 takes several times as long as float32 on this processor, which has no "
            "instructions for it; give --policy.dtype=float32"
        )


def is_bfloat16_fast() -> bool:
    """Return False if this CPU has no instructions that torch computes bfloat16 products with."""
    # torch has no public question for it; of other libraries than oneDNN it knows nothing
    return not torch.backends.mkldnn.is_available() or torch.ops.mkldnn._is_mkldnn_bf16_supported()


def _float32(value: Any) -> Any:
    return value.float() if isinstance(value, Tensor) and value.is_floating_point() else value


def causal_mask(attention_mask_BL: Tensor) -> Tensor:
    """(B, L) bool -> (B, L, L): a token (row) attends to itself and those before it that are in the mask."""
    column_L = torch.arange(attention_mask_BL.shape[1], device=attention_mask_BL.device)
    causal_LL = column_L[:, None] >= column_L
    return causal_LL & attention_mask_BL[:, None]


def attention_bias(attention_mask_BLX: Tensor, dtype: torch.dtype) -> Tensor:
    """(B, 1, L, X) added to the attention logits: 0 where the mask is True, else the type's lowest number."""
    return torch.where(attention_mask_BLX, 0.0, torch.finfo(dtype).min).to(dtype)[:, None]
