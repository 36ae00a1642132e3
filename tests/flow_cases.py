"""Points of the straight path from noise to actions, and heads that are known exactly."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from lerobot_bomb.flow.path import PathPoint, path_point

CONSISTENCY_ONLY: dict[str, Any] = {
    "flow_loss_weight": 0.0,
    "denoise_loss_weight": 0.0,
    "consistency_loss_weight": 1.0,
}


def gaussian_heads(mean: Tensor | float, std: float) -> Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Conditional means of A0 - z and of z for A0 ~ N(mean, std^2); of a point mass for std = 0."""

    def heads(actions_BKD: Tensor, tau_B: Tensor) -> tuple[Tensor, Tensor]:
        tau = tau_B[:, None, None]
        whitened = (actions_BKD - tau * mean) / (tau**2 * std**2 + (1 - tau) ** 2)
        noise_BKD = (1 - tau) * whitened
        return mean + tau * std**2 * whitened - noise_BKD, noise_BKD

    return heads


def random_point(batch_size: int, dtype: torch.dtype = torch.float32) -> PathPoint:
    """Draw a point for chunks of 5 actions with 3 dims; its actions require gradients."""
    generator = torch.Generator().manual_seed(0)
    clean, noise = torch.randn(2, batch_size, 5, 3, generator=generator, dtype=dtype)
    point = path_point(clean, noise, torch.rand(batch_size, generator=generator, dtype=dtype))
    point.actions.requires_grad_()
    return point
