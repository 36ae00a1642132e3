"""Check that a checkpoint's architecture fits into this machine's memory, before that is filled."""

import os
from collections.abc import Callable
from typing import Any

import torch
from torch import nn

GIB = 2**30


def check_memory(vlm_config: dict[str, Any], build: Callable[[], nn.Module], dtype: torch.dtype) -> None:
    """Check that the model of a `vlm_config` fits into this machine's memory.

    ``dtype``: of most of its weights.

    Raises:
        ValueError: the model does not fit, or the config describes none.
    """
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:
        # layers are objects even on the device `meta`, so they are counted first
        parts = (vlm_config.get(part) or {} for part in ("text_config", "vision_config"))
        size = dtype.itemsize * sum(map(_num_weights, parts))
        if size <= memory:
            with torch.device("meta"), torch.random.fork_rng(devices=[]):
                size = sum(weight.numel() * weight.element_size() for weight in build().parameters())
    except Exception as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"--policy.vlm_config describes no model: {reason}") from error
    if size > memory:
        raise ValueError(
            f"--policy.vlm_config describes a model of at least {size / GIB:.0f} GiB, and this machine has "
            f"{memory / GIB:.1f} GiB of memory"
        )


def _num_weights(config: dict[str, Any]) -> int:
    """Count the weights that the layers have at least: those of two projections each."""
    num_layers = config.get("num_hidden_layers") or config.get("depth") or 0
    return num_layers * 2 * config.get("hidden_size", 1) * config.get("intermediate_size", 1)
