"""Pointing of ``fdvla`` before it acts: place, stone and whether it is held, read from an action token.

The prediction enters the action tokens ahead of both heads, as the ways that the gripper has to go.

Shapes: `B` batch, `P` places, `S` spots where stones lie, `H` hidden size, `D` action dims, `R` state dims.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
from lerobot.configs import NormalizationMode
from lerobot.datasets import LeRobotDatasetMetadata
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, cross_entropy, smooth_l1_loss

from lerobot_bomb.bomb.pointing import SPOTS_XY_M, PointedAt
from lerobot_bomb.policies.pointing import DataUnits, Labels, number_of
from lerobot_bomb.policies.pointing_policy import Parts
from lerobot_policy_bomb.fdvla.configuration_fdvla import FdvlaConfig

FEEDBACK_DIM = 128
NUM_NUMBERS = 20
# metres: a way across the board, its last part, a precise end
FAR_M, NEAR_M, FINE_M = 0.1, 0.03, 0.006


@dataclass(frozen=True)
class Pointed:
    """A prediction, and where the gripper is."""

    gripper: Tensor  # (B, 3) metres
    place_logits: Tensor  # (B, P)
    spot_logits: Tensor  # (B, S) where the stone is; a mean of two possible stones would be neither
    stone: Tensor  # (B, 2) metres from the gripper, near the likeliest spot
    held_logit: Tensor  # (B,)
    features: Tensor  # (B, H)


class Pointer(DataUnits):
    """Heads on an action token's state, and the feedback into the action tokens.

    Before training the feedback is exactly zero.
    """

    places: Tensor  # (P, 2) metres
    spots: Tensor  # (S, 2) metres

    def __init__(
        self,
        hidden_size: int,
        action_dim: int,
        places: list[list[float]],
        action_mode: NormalizationMode,
    ):
        super().__init__(action_dim, action_mode)
        self.register_buffer("places", torch.tensor(places))
        self.features = nn.Sequential(nn.Linear(hidden_size, hidden_size), nn.SiLU())
        self.register_buffer("spots", torch.tensor(SPOTS_XY_M), persistent=False)
        self.place, self.spot = nn.Linear(hidden_size, len(places)), nn.Linear(hidden_size, len(SPOTS_XY_M))
        self.held = nn.Linear(hidden_size, 1)
        # the stone's offset from a spot, given the way from the gripper to the spot
        self.stone = nn.Sequential(
            nn.Linear(hidden_size + 4, hidden_size), nn.SiLU(), nn.Linear(hidden_size, 2)
        )
        last = nn.Linear(FEEDBACK_DIM, hidden_size)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.feedback = nn.Sequential(nn.Linear(NUM_NUMBERS, FEEDBACK_DIM), nn.SiLU(), last)

    def forward(self, state_BH: Tensor, robot_state_BR: Tensor) -> Pointed:
        """An action token's state and the normalised state of the robot -> what they point at."""
        features_BH, gripper_B3 = self.features(state_BH), self.gripper(robot_state_BR)
        spot_logits_BS = self.spot(features_BH).float()
        return Pointed(
            gripper_B3,
            self.place(features_BH).float(),
            spot_logits_BS,
            self._stone(features_BH, gripper_B3, spot_logits_BS.argmax(dim=1)),
            self.held(features_BH).float()[:, 0],
            features_BH,
        )

    def _stone(self, features_BH: Tensor, gripper_B3: Tensor, spot_B: Tensor) -> Tensor:
        """Return the stone near a spot, (B, 2) metres from the gripper."""
        way_B2 = self.spots[spot_B] - gripper_B3[:, :2]
        scaled_B4 = torch.cat([way_B2 / FAR_M, torch.tanh(way_B2 / NEAR_M)], dim=1)
        beside_B2 = self.stone(torch.cat([features_BH, scaled_B4.to(features_BH.dtype)], dim=1))
        return way_B2 + NEAR_M * beside_B2.float()

    def feed_back(self, pointed: Pointed, place_B: Tensor | None = None) -> Tensor:
        """Return (B, H) to be added to action tokens, for these places or else the likeliest.

        No gradient reaches the prediction.
        """
        place_B = pointed.place_logits.argmax(dim=1) if place_B is None else place_B
        return self.feedback(self._numbers(pointed, self.places[place_B]).detach())

    @staticmethod
    def _numbers(pointed: Pointed, place_B2: Tensor) -> Tensor:
        """(B, NUM_NUMBERS): ways to place and stone, from one to the other, whether it is held, height."""
        ways = place_B2 - pointed.gripper[:, :2], pointed.stone
        scaled = [part for way_B2 in ways for part in _at_scales(way_B2)]
        between_B2 = (ways[0] - ways[1]) / NEAR_M
        rest = between_B2, pointed.held_logit.sigmoid()[:, None], pointed.gripper[:, 2:]
        return torch.cat([*scaled, *rest], dim=1)

    def pointed_at(self, pointed: Pointed) -> PointedAt:
        """Return one row's prediction in metres, and how likely each place is."""
        (shares,) = pointed.place_logits.softmax(dim=1).tolist()
        return PointedAt(
            place_xy=self.places[pointed.place_logits[0].argmax()].double().cpu().numpy(),
            stone_xy=(pointed.gripper[0, :2] + pointed.stone[0]).double().cpu().numpy(),
            held=float(pointed.held_logit.sigmoid()),
            probabilities={(x, y): share for (x, y), share in zip(self.places.tolist(), shares, strict=True)},
        )

    def losses(self, pointed: Pointed, labels: Labels) -> dict[str, Tensor]:
        """Return losses, (B,) each, of place, spot, stone in units of `NEAR_M`, and whether it is held."""
        way_B2, spot_B = labels.stone_xy - pointed.gripper[:, :2], number_of(labels.stone_xy, self.spots)
        stone_B2 = self._stone(pointed.features, pointed.gripper, spot_B)
        errors_B2 = smooth_l1_loss(stone_B2 / NEAR_M, way_B2 / NEAR_M, reduction="none", beta=0.1)
        return {
            "place_loss": cross_entropy(pointed.place_logits, labels.place, reduction="none"),
            "spot_loss": cross_entropy(pointed.spot_logits, spot_B, reduction="none"),
            "stone_loss": errors_B2.mean(dim=1),
            "held_loss": binary_cross_entropy_with_logits(pointed.held_logit, labels.held, reduction="none"),
        }

    @torch.no_grad()
    def parts(self, pointed: Pointed, labels: Labels) -> Parts:
        """Return which places and spots are right, as `means` takes them."""
        right = {
            "place": pointed.place_logits.argmax(dim=1) == labels.place,
            "spot": pointed.spot_logits.argmax(dim=1) == number_of(labels.stone_xy, self.spots),
        }
        return {f"{name}_accuracy": (right_B, torch.ones_like(right_B)) for name, right_B in right.items()}

    def labels(
        self, batch: dict[str, Any], other_share: float, policy_type: str, generator: torch.Generator
    ) -> Labels:
        """Read a batch's labels and draw the given places; actions are as LeRobot normalises them."""
        labels = Labels.draw(batch, self.places, other_share, policy_type, generator)
        return replace(labels, other_actions=self.normalised(labels.other_actions))


def make_pointer(
    config: FdvlaConfig, hidden_size: int, meta: LeRobotDatasetMetadata | None
) -> Pointer | None:
    """Make the pointer; None without `pointing`. Its places are a checkpoint's or else the dataset's.

    Raises:
        ValueError: neither has places.
    """
    if not config.pointing:
        return None
    places = config.take_places(meta)
    assert config.action_feature is not None
    mode = config.normalization_mapping["ACTION"]
    pointer = Pointer(hidden_size, config.action_feature.shape[0], places, mode)
    if meta is not None:
        pointer.fit_units(meta, config.normalization_mapping)
    return pointer


def _at_scales(way_B2: Tensor) -> list[Tensor]:
    length_B1 = way_B2.norm(dim=1, keepdim=True)
    return [
        way_B2 / FAR_M,
        (0.75 * way_B2 / NEAR_M).clamp(-1, 1),
        torch.tanh(way_B2 / FINE_M),
        length_B1 / FAR_M,
        torch.tanh(length_B1 / FINE_M),
    ]
