"""Pointing of ``spatialvla_grid`` before it acts: two tokens ahead of the cells, for a place and a stone.

The decoder chooses actions after these tokens, so they follow the pointing.

Shapes: `B` batch, `P` places, `D` action dims, `N` tokens ahead of the cells.
"""

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from lerobot.configs import NormalizationMode
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION
from torch import Tensor, nn

from lerobot_bomb.actions.relative import Statistics, bounds
from lerobot_bomb.bomb.pointing import PointedAt
from lerobot_bomb.policies.pointing import Labels, normalised_actions

if TYPE_CHECKING:
    from lerobot_policy_bomb.spatialvla_grid.configuration_spatialvla_grid import SpatialvlaGridConfig

NAMES = "place", "stone"  # of the tokens, in order
CELL_M = 0.001, 0.05  # least and largest side: of a camera's precision, and about a stone's distance


@dataclass(frozen=True)
class StoneCells:
    """Square cells of the board's plane, numbered along y, then x; the outermost include all beyond."""

    low_m: tuple[float, float]
    high_m: tuple[float, float]
    cell_m: float

    @classmethod
    def of_flags(cls, area_m: list[list[float]], cell_m: float) -> "StoneCells":
        """Build the cells; raise a ValueError, which names the flag, if their size or the area is wrong."""
        if not CELL_M[0] <= cell_m <= CELL_M[1]:
            raise ValueError(f"--policy.pointing_cell_m={cell_m} must lie in {CELL_M[0]:g}..{CELL_M[1]:g}")
        if [len(corner) for corner in area_m] == [2, 2]:
            (low_x, low_y), (high_x, high_y) = area_m
            if all(map(math.isfinite, (low_x, low_y, high_x, high_y))) and low_x < high_x and low_y < high_y:
                return cls((low_x, low_y), (high_x, high_y), cell_m)
        raise ValueError(
            f"--policy.pointing_area_m={area_m} must be [[x, y], [x, y]] in metres, the second beyond the "
            "first in both"
        )

    @property
    def counts(self) -> tuple[int, int]:
        """Cells along x and along y; the last ones may reach beyond the area."""
        x, y = (
            math.ceil(round((high - low) / self.cell_m, 6))
            for low, high in zip(self.low_m, self.high_m, strict=True)
        )
        return x, y

    def number_of(self, xy_B2: Tensor) -> Tensor:
        """Return the number of each point's cell, (B,) int64."""
        last_2 = xy_B2.new_tensor(self.counts) - 1
        cells_B2 = ((xy_B2 - xy_B2.new_tensor(self.low_m)) / self.cell_m).floor().clamp(min=0)
        x_B, y_B = torch.minimum(cells_B2, last_2).long().unbind(dim=1)
        return x_B * self.counts[1] + y_B

    def center_of(self, number: int) -> tuple[float, float]:
        """Return (x, y) in metres of a cell's middle."""
        x, y = divmod(number, self.counts[1])
        return self.low_m[0] + (x + 0.5) * self.cell_m, self.low_m[1] + (y + 0.5) * self.cell_m


@dataclass(frozen=True)
class Target:
    """Tokens ahead of a chunk's cells; without pointing N = 0."""

    given: Tensor  # (B, N) int64, among those that may stand there: what the actions follow
    meant: Tensor  # (B, N) int64, what is to be predicted

    @classmethod
    def nothing(cls, batch_size: int, device: torch.device) -> "Target":
        tokens_BN = torch.zeros(batch_size, 0, dtype=torch.int64, device=device)
        return cls(tokens_BN, tokens_BN)

    def parts(self, chosen_BN: Tensor) -> dict[str, tuple[Tensor, Tensor]]:
        """Return which tokens are right, as `means` takes them."""
        right = zip(NAMES, (chosen_BN == self.meant).T, strict=False)
        return {f"{name}_accuracy": (right_B, torch.ones_like(right_B)) for name, right_B in right}


class CellPointer(nn.Module):
    """Turns a batch's labels into tokens for places and stones; the config has all that it holds."""

    places: Tensor  # (P, 2) metres
    action_bounds: Tensor  # (2, D) the environment's actions that are -1 and 1; known while training

    def __init__(self, places: list[list[float]], stones: StoneCells, action_dim: int):
        super().__init__()
        self.register_buffer("places", torch.tensor(places), persistent=False)
        bounds_2D = torch.tensor([[-1.0], [1.0]]).repeat(1, action_dim)
        self.register_buffer("action_bounds", bounds_2D, persistent=False)
        self.stones = stones
        self.num_tokens = len(places) + math.prod(stones.counts)

    def slots(self, first: int) -> list[slice]:
        """Return the rows of the tables that may be chosen for each token; ``first``: the first place's."""
        first_stone = first + len(self.places)
        return [slice(first, first_stone), slice(first_stone, first + self.num_tokens)]

    def pointed_at(self, tokens_N: Tensor, shares_P: Tensor) -> PointedAt:
        """(N,) chosen tokens and (P,) probabilities of places -> what is pointed at, in metres."""
        place, stone = tokens_N.tolist()
        places = [(x, y) for x, y in self.places.tolist()]
        return PointedAt(
            place_xy=np.array(places[place]),
            stone_xy=np.array(self.stones.center_of(stone)),
            probabilities=dict(zip(places, shares_P.tolist(), strict=True)),
        )

    @torch.no_grad()
    def fit(self, actions: Statistics, mode: NormalizationMode) -> None:
        """Take the normalisation of actions from their statistics."""
        low_D, high_D = bounds(actions, mode, self.action_bounds.shape[1])
        self.action_bounds.copy_(torch.from_numpy(np.stack([low_D, high_D])))

    def labels(
        self, batch: dict[str, Any], other_share: float, policy_type: str, generator: torch.Generator
    ) -> tuple[Labels, Target]:
        """Read a batch's labels, actions as LeRobot normalises them, and draw the tokens that are given.

        The place that is meant is predicted from the prompt alone, also where another one is given.
        """
        labels = Labels.draw(batch, self.places, other_share, policy_type, generator)
        stone_B = self.stones.number_of(labels.stone_xy)
        given_B2, meant_B2 = (
            torch.stack([place_B, stone_B], dim=1) for place_B in (labels.given, labels.place)
        )
        others_BD = normalised_actions(labels.other_actions, self.action_bounds)
        return replace(labels, other_actions=others_BD), Target(given_B2, meant_B2)


def make_pointer(config: "SpatialvlaGridConfig", meta: LeRobotDatasetMetadata | None) -> CellPointer | None:
    """Make the pointer; None without `pointing`. Its places are a checkpoint's or else the dataset's.

    Raises:
        ValueError: neither has places.
    """
    if not config.pointing:
        return None
    assert config.action_feature is not None
    pointer = CellPointer(config.take_places(meta), config.stone_cells(), config.action_feature.shape[0])
    if meta is not None:
        assert meta.stats is not None
        pointer.fit(meta.stats[ACTION], config.normalization_mapping["ACTION"])
    return pointer
