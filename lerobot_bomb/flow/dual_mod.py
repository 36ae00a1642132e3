"""DualMod: pooled features of the vision-language model scale and shift a head's features (FDVLA).

Shapes: `B` batch, `T` tokens, `K` action steps, `R` size of the model's states, `H` of a head's features.
"""

import torch
from torch import Tensor, nn
from torch.nn.init import zeros_


def masked_mean_pool(states_BTR: Tensor, mask_BT: Tensor) -> Tensor:
    """(B, R) mean of the states in the mask; zeros where it is empty."""
    mask_BT1 = mask_BT[..., None]
    return (states_BTR * mask_BT1).sum(dim=1) / mask_BT1.sum(dim=1).clamp(min=1)


def modulate(features_BKH: Tensor, gamma_B1H: Tensor, beta_B1H: Tensor) -> Tensor:
    """Scale and shift features (B, K, H)."""
    return gamma_B1H * features_BKH + beta_B1H


class FiLM(nn.Module):
    """gamma * h + beta, with gamma and beta (B, H) from pooled states (B, R), the same for all action steps.

    Feature-wise linear modulation (Perez et al. 2017, arXiv 1709.07871); DualMod has one for each head.
    It is exactly the identity before training.
    """

    def __init__(self, state_size: int, dualmod_dim: int, head_dim: int):
        super().__init__()
        last = nn.Linear(dualmod_dim, 2 * head_dim)
        zeros_(last.weight)
        with torch.no_grad():
            last.bias.copy_(torch.cat([torch.ones(head_dim), torch.zeros(head_dim)]))
        self.layers = nn.Sequential(
            nn.LayerNorm(state_size), nn.Linear(state_size, dualmod_dim), nn.SiLU(), last
        )

    def coefficients(self, pooled_BR: Tensor) -> tuple[Tensor, Tensor]:
        """Return gamma and beta, (B, 1, H) each."""
        gamma_B1H, beta_B1H = self.layers(pooled_BR)[:, None].chunk(2, dim=-1)
        return gamma_B1H, beta_B1H

    def forward(self, features_BKH: Tensor, pooled_BR: Tensor) -> Tensor:
        return modulate(features_BKH, *self.coefficients(pooled_BR))
