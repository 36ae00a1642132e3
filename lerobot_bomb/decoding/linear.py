"""Projections that are called many times, on few tokens."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeGuard

import torch
from torch import Tensor, nn

Linears = Callable[[Tensor], list[Tensor]]


def make_linears(modules: Sequence[nn.Module], *, are_copies: bool) -> Linears:
    """Join projections of one input in a function; plain copies become one product of adjacent weights."""
    linears = [module for module in modules if is_plain(module)]
    if not are_copies or len(linears) < len(modules):
        products = [make_linear(module) for module in modules]
        return lambda x: [product(x) for product in products]
    joined = []
    for parts in zip(*(linear.parameters() for linear in linears), strict=True):
        joined.append(torch.cat([part.detach() for part in parts]))
        for part, own in zip(parts, joined[-1].split([len(part) for part in parts]), strict=True):
            part.data = own
    product = multiply(*joined)
    return lambda x: [product(x)]


def make_linear(module: nn.Module) -> Callable[[Tensor], Tensor]:
    """Return a projection; a plain one skips `Module.__call__`, which is half of a small product's time."""
    return multiply(*module.parameters()) if is_plain(module) else module


def multiply(weight: Tensor, bias: Tensor | None = None) -> Callable[[Tensor], Tensor]:
    """Return the product with a weight (O, H), a function (N, H) -> (N, O)."""
    transposed = weight.detach().t()
    return partial(torch.mm, mat2=transposed) if bias is None else partial(torch.addmm, bias, mat2=transposed)


def is_plain(module: nn.Module) -> TypeGuard[nn.Linear]:
    """Return True if a module is a linear layer with nothing but a weight and perhaps a bias."""
    return type(module) is nn.Linear and not (module._forward_hooks or module._forward_pre_hooks)


def cast(x: Tensor, dtype: torch.dtype) -> Tensor:
    """Convert as `Tensor.to`, which takes as long as a small product even with nothing to do."""
    return x if x.dtype == dtype else x.to(dtype)
