"""Straight path from noise to actions, and the targets of two heads on it.

A^tau = (1 - tau) z + tau A0: noise z ~ N(0, I) at tau = 0, clean actions A0 at tau = 1 (flow matching, Lipman
et al. 2022, arXiv 2210.02747). Shapes: `B` batch, `K` action steps, `D` action dims.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from lerobot_bomb.flags import one_of

TIME_SAMPLINGS = ("uniform", "beta")
BETA_SHAPE, BETA_END = 1.5, 0.999  # pi0, arXiv 2410.24164, appendix B


@dataclass(frozen=True)
class PathPoint:
    """Noisy actions, in normalised units, and the targets of both heads there."""

    actions: Tensor  # (B, K, D) A^tau
    tau: Tensor  # (B,) in [0, 1], one for all of a chunk
    velocity: Tensor  # (B, K, D) A0 - z = (A0 - A^tau) / (1 - tau)
    noise: Tensor  # (B, K, D) z = A^tau - tau * velocity

    def implied_actions(
        self, velocity_BKD: Tensor | None, noise_BKD: Tensor | None, tau_min: float, clip_range: float
    ) -> Tensor:
        """Return the clean actions (B, K, D) implied by a predicted velocity, or by noise if there is none.

        For noise, ``tau_min`` is the least tau that is divided by, and ``clip_range`` bounds the actions.
        """
        tau_B11 = self.tau[:, None, None]
        if velocity_BKD is not None:
            return self.actions + (1 - tau_B11) * velocity_BKD.float()
        assert noise_BKD is not None
        tau_B11 = tau_B11.clamp(min=tau_min)
        clean_BKD = (self.actions - (1 - tau_B11) * noise_BKD.float()) / tau_B11
        return clean_BKD.clamp(-clip_range, clip_range)


def path_point(clean_BKD: Tensor, noise_BKD: Tensor, tau_B: Tensor) -> PathPoint:
    """Return the points at tau on the paths from noise z to clean actions A0."""
    tau_B11 = tau_B[:, None, None]
    actions_BKD = (1 - tau_B11) * noise_BKD + tau_B11 * clean_BKD
    return PathPoint(actions_BKD, tau_B, clean_BKD - noise_BKD, noise_BKD)


def draw_tau(time_sampling: str, batch_size: int, generator: torch.Generator) -> Tensor:
    """Draw tau for training, (B,) float32 in [0, 1) on the generator's device.

    ``uniform``, or ``beta``: pi0's 0.999 (1 - u) with u ~ Beta(1.5, 1), most of it near the noise.

    Raises:
        ValueError: ``time_sampling`` is none of these.
    """
    one_of("time_sampling", time_sampling, TIME_SAMPLINGS)
    uniform_B = torch.rand(batch_size, generator=generator, device=generator.device)
    if time_sampling == "uniform":
        return uniform_B
    return BETA_END * (1 - uniform_B ** (1 / BETA_SHAPE))  # u^a is the distribution function of Beta(a, 1)
