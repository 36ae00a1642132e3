"""Networks that ``fdvla`` adds to the vision-language model: noisy actions as tokens, and the heads.

Shapes: `B` batch, `K` action steps, `D` action dims, `H` hidden size of the language model, `F` of a head's
features, `T` = K + 3 tokens of a segment, `O` observations with `J` draws each.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from lerobot_bomb.flow.dual_mod import FiLM, modulate

NUM_MARKS = 3  # tokens of a segment that are no action: its begin, the time, its end
TIME_SIZE = 256
PERIODS = 4e-3, 4.0  # of the first and the last wave; pi0, arXiv 2410.24164
INIT_STD = 0.02


def time_waves(tau_B: Tensor) -> Tensor:
    """(B,) in [0, 1] -> (B, TIME_SIZE) sines and cosines of periods that grow geometrically."""
    shortest, longest = PERIODS
    exponents = torch.linspace(0, 1, TIME_SIZE // 2, device=tau_B.device)
    angles_BW = 2 * math.pi * tau_B[:, None] / (shortest * (longest / shortest) ** exponents)
    return torch.cat([angles_BW.sin(), angles_BW.cos()], dim=1)


def _mlp(num_inputs: int, width: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(num_inputs, width), nn.SiLU(), nn.Linear(width, width))


class ActionSegment(nn.Module):
    """Noisy actions and their time as tokens: begin, time, K actions, end."""

    def __init__(self, chunk_size: int, action_dim: int, hidden_size: int):
        super().__init__()
        self.marks = nn.Parameter(INIT_STD * torch.randn(2, hidden_size))
        self.positions = nn.Parameter(INIT_STD * torch.randn(chunk_size, hidden_size))
        self.time = _mlp(TIME_SIZE, hidden_size)
        self.actions = _mlp(action_dim, hidden_size)

    def forward(self, actions_BKD: Tensor, tau_B: Tensor) -> Tensor:
        """Return the segment's tokens (B, T, H)."""
        time_B1H = self.time(time_waves(tau_B))[:, None]
        actions_BKH = self.actions(actions_BKD) + self.positions + time_B1H
        begin_B1H, end_B1H = self.marks[:, None, None].expand(-1, len(tau_B), -1, -1)
        return torch.cat([begin_B1H, time_B1H, actions_BKH, end_B1H], dim=1)

    @staticmethod
    def of_actions(states_BTH: Tensor) -> Tensor:
        """Return the states (B, K, H) of the actions' tokens."""
        return states_BTH[:, NUM_MARKS - 1 : -1]

    @staticmethod
    def attention_mask(attended_BK: Tensor, *, causal: bool) -> Tensor:
        """(B, T, T) attention mask of a segment, a row for each token that attends."""
        marks_B1 = torch.ones_like(attended_BK[:, :1])
        keys_BT = torch.cat([marks_B1, marks_B1, attended_BK, marks_B1], dim=1)
        attention_mask_BTT = keys_BT[:, None].expand(-1, keys_BT.shape[1], -1)
        return attention_mask_BTT.tril() if causal else attention_mask_BTT


@dataclass(frozen=True)
class SideBySide:
    """Segments of several draws of an observation side by side; none attends to another's tokens."""

    number: int

    def joined(self, embeds_BTH: Tensor) -> Tensor:
        """(B, T, H) -> (B / number, number * T, H)."""
        return embeds_BTH.reshape(-1, self.number * embeds_BTH.shape[1], embeds_BTH.shape[2])

    def attention_mask(self, attention_mask_BTT: Tensor) -> Tensor:
        """Join attention masks: (B, T, T) -> (B / number, number * T, number * T) bool."""
        is_own_JJ = torch.eye(self.number, dtype=torch.bool, device=attention_mask_BTT.device)
        attention_mask_OJTT = attention_mask_BTT.unflatten(0, (-1, self.number))
        attention_mask_OJTJT = attention_mask_OJTT[:, :, :, None] & is_own_JJ[:, None, :, None]
        return attention_mask_OJTJT.flatten(3).flatten(1, 2)


class Head(nn.Module):
    """States of the action tokens -> (B, K, D), modulated by pooled states of the prompt."""

    def __init__(self, hidden_size: int, head_dim: int, action_dim: int, dualmod_dim: int | None):
        super().__init__()
        self.features = _mlp(hidden_size, head_dim)
        self.film = None if dualmod_dim is None else FiLM(hidden_size, dualmod_dim, head_dim)
        self.out = nn.Linear(head_dim, action_dim)

    def forward(self, states_BKH: Tensor, modulation: tuple[Tensor, Tensor] | None) -> Tensor:
        """(B, K, H) states and the prompt's `modulation` -> (B, K, D)."""
        features_BKF = self.features(states_BKH)
        if modulation is not None:
            features_BKF = modulate(features_BKF, *modulation)
        return self.out(features_BKF)

    def modulation(self, pooled_BH: Tensor) -> tuple[Tensor, Tensor] | None:
        """Return scale and shift of the features from (B, H) pooled states, for all sampling steps."""
        return None if self.film is None else self.film.coefficients(pooled_BH)
