"""Point, then act: predict which stone goes where, then the actions; labels are read in training only.

A policy that predicts the right place may still not go there, because demonstrations rarely force it to. So
on some training frames it is given another place, and the expert's action for it.

Shapes: `B` batch, `P` places, `K` actions of a chunk, `D` action dims.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from lerobot.configs import NormalizationMode
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION, OBS_PREFIX, OBS_STATE
from torch import Tensor, nn

from lerobot_bomb.actions.relative import bounds
from lerobot_bomb.bomb.pointing import COLUMNS, NUM_OTHERS, PREFIX
from lerobot_bomb.data.columns import dim_names, present_episodes, read_columns
from lerobot_bomb.vlm.inputs import read_tensor

LABELS = f"{OBS_PREFIX}{PREFIX}"  # prefix of the labels' columns in a dataset
PLACE, STONE, OTHER_PLACES, OTHER_ACTIONS, SPOTS = (f"{OBS_PREFIX}{name}" for name in COLUMNS)
GRIPPER = ("x", "y", "z")  # dimensions of the state
SAME_PLACE_M = 1e-3
# share of the labels that may be where a policy cannot point: in its own episodes, a stone may fall off the
# table, or its part of the tray be taken
RARE = 0.01
SMALLEST = 1e-8  # difference that LeRobot's normaliser divides by


@dataclass(frozen=True)
class MetricLabels:
    """Labels of a batch in metres: the stone and place that its frames point at, and the given place."""

    place_xy: Tensor  # (B, 2) metres, the place that is meant
    stone_xy: Tensor  # (B, 2) metres
    held: Tensor  # (B,) in [0, 1]
    is_other: Tensor  # (B,) bool, whether another place is given
    given_xy: Tensor  # (B, 2) metres, the place that is given
    other_actions: Tensor  # (B, D) the expert's for another place, in the environment's units

    @classmethod
    def read(
        cls,
        batch: dict[str, Any],
        other_share: float,
        policy_type: str,
        device: torch.device,
        generator: torch.Generator,
    ) -> Self:
        """Read a batch's labels; a share of its frames is given one of their other places."""

        def read(key: str) -> Tensor:
            return read_tensor(batch, key, policy_type, device).float()

        place_B2, stone_B3 = read(PLACE), read(STONE)
        drawn_B = torch.randint(NUM_OTHERS, (len(place_B2),), generator=generator).to(device)
        is_other_B = (torch.rand(len(place_B2), generator=generator) < other_share).to(device)
        row_B = torch.arange(len(place_B2), device=device)
        other_B2, other_actions_BD = (
            read(key).unflatten(1, (NUM_OTHERS, -1))[row_B, drawn_B] for key in (OTHER_PLACES, OTHER_ACTIONS)
        )
        given_B2 = torch.where(is_other_B[:, None], other_B2, place_B2)
        return cls(place_B2, stone_B3[:, :2], stone_B3[:, 2], is_other_B, given_B2, other_actions_BD)

    def given_actions(
        self, actions_BKD: Tensor, loss_mask_BK: Tensor, other_B1D: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the actions (B, K, D) for the given places, and the mask (B, K) of those that are known.

        ``other_B1D``: `other_actions`, as ``actions_BKD`` are. For another place only the next one is known.
        """
        is_first_K = torch.arange(actions_BKD.shape[1], device=actions_BKD.device) == 0
        is_other_BK = self.is_other[:, None] & is_first_K
        actions_BKD = torch.where(is_other_BK[..., None], other_B1D, actions_BKD)
        return actions_BKD, loss_mask_BK & (is_first_K | ~self.is_other[:, None])


@dataclass(frozen=True)
class Labels(MetricLabels):
    """Labels with numbers of places, for a policy that has a table of them."""

    place: Tensor  # (B,) int64, number of the place that is meant
    given: Tensor  # (B,) int64, number of the place that is given

    @classmethod
    def draw(
        cls,
        batch: dict[str, Any],
        places_P2: Tensor,
        other_share: float,
        policy_type: str,
        generator: torch.Generator,
    ) -> Self:
        """Read a batch as `MetricLabels` does; places are the nearest of the table."""
        read = MetricLabels.read(batch, other_share, policy_type, places_P2.device, generator)
        place_B, given_B = (number_of(xy_B2, places_P2) for xy_B2 in (read.place_xy, read.given_xy))
        return cls(**vars(read), place=place_B, given=given_B)


class DataUnits(nn.Module):
    """Gripper positions and actions of a dataset that LeRobot normalises to -1 and 1.

    A checkpoint keeps these bounds, because its labels are in metres and in the environment's units.
    """

    state_bounds: Tensor  # (2, 3) metres of the gripper that are -1 and 1 in a normalised state
    action_bounds: Tensor  # (2, D) the same of the environment's actions
    gripper_dims: Tensor  # (3,) int64, of the state

    def __init__(self, action_dim: int, action_mode: NormalizationMode):
        super().__init__()
        self._action_mode = action_mode
        self.register_buffer("state_bounds", torch.tensor([[-1.0], [1.0]]).repeat(1, 3))
        self.register_buffer("action_bounds", torch.tensor([[-1.0], [1.0]]).repeat(1, action_dim))
        self.register_buffer("gripper_dims", torch.arange(3))

    @torch.no_grad()
    def fit_units(self, meta: LeRobotDatasetMetadata, modes: Mapping[str, Any]) -> None:
        """Take the bounds from a dataset that is normalised by these modes."""
        dims = gripper_dims(meta)
        self.gripper_dims.copy_(torch.tensor(dims))
        self.state_bounds.copy_(unit_bounds(meta, OBS_STATE, modes["STATE"])[:, dims])
        self.action_bounds.copy_(unit_bounds(meta, ACTION, modes["ACTION"]))

    def gripper(self, state_BS: Tensor) -> Tensor:
        """(B, S) normalised states -> (B, 3) metres."""
        low_3, high_3 = self.state_bounds
        return low_3 + (state_BS.float()[:, self.gripper_dims] + 1) / 2 * (high_3 - low_3)

    def normalised(self, actions_BD: Tensor) -> Tensor:
        """(B, D) actions in the environment's units -> as LeRobot normalises them."""
        return normalised_actions(actions_BD, self.action_bounds, self._action_mode)


def normalised_actions(
    actions_BD: Tensor, bounds_2D: Tensor, mode: NormalizationMode = NormalizationMode.MIN_MAX
) -> Tensor:
    """Normalise actions (B, D) as LeRobot does; ``bounds_2D`` become -1 and 1."""
    low_D, high_D = bounds_2D
    size_D = high_D - low_D
    # so what never changes is 0 by mean and standard deviation, else -1
    if mode is NormalizationMode.MEAN_STD:
        return (actions_BD - (low_D + high_D) / 2) / (size_D / 2 + SMALLEST)
    return 2 * (actions_BD - low_D) / torch.where(size_D == 0, SMALLEST, size_D) - 1


def number_of(xy_B2: Tensor, places_P2: Tensor) -> Tensor:
    """Return the number of the place nearest to each point, (B,) int64."""
    return torch.cdist(xy_B2, places_P2).argmin(dim=1)


def require_labels(meta: LeRobotDatasetMetadata, *, reads_board: bool) -> None:
    """Raise a ValueError unless a dataset has the columns that pointing is trained on."""
    wanted = (PLACE, STONE, OTHER_PLACES, OTHER_ACTIONS, *([SPOTS] if reads_board else []))
    missing = [key for key in wanted if key not in meta.features]
    if missing:
        without = "; --policy.board_loss_weight=0 does without" if missing == [SPOTS] else ""
        raise ValueError(
            f"--policy.pointing=true is trained on the columns {', '.join(missing)}, which {meta.repo_id} "
            f"lacks; lerobot-bomb record --pointing writes them{without}"
        )


def places_of(meta: LeRobotDatasetMetadata, known: list[list[float]] | None) -> list[list[float]]:
    """Return the places (P, 2) in metres of a dataset's labels, or ``known`` if it includes nearly all.

    Raises:
        ValueError: the dataset often points at places that the checkpoint does not know.
    """
    columns = read_columns(meta, (PLACE, OTHER_PLACES), present_episodes(meta))
    points = np.concatenate([columns[key].reshape(-1, 2) for key in (PLACE, OTHER_PLACES)])
    found, counts = np.unique(points, axis=0, return_counts=True)
    if known is None:
        return found.astype(np.float64).round(6).tolist()
    apart_m = np.linalg.norm(found[:, None] - np.array(known), axis=-1).min(axis=1)
    if counts[apart_m > SAME_PLACE_M].sum() > RARE * counts.sum():
        raise ValueError(
            f"--policy.pointing=true: {meta.repo_id} points at {found[apart_m.argmax()].tolist()}, which is "
            "no place of this checkpoint; train one of its own"
        )
    return known


def gripper_dims(meta: LeRobotDatasetMetadata) -> list[int]:
    """Return the dims of x, y and z in the state."""
    names = dim_names(meta.features[OBS_STATE])
    if missing := [name for name in GRIPPER if name not in names]:
        raise ValueError(
            f"--policy.pointing=true needs the gripper's {', '.join(missing)} in {OBS_STATE}; {meta.repo_id} "
            f"has {', '.join(names)}"
        )
    return [names.index(name) for name in GRIPPER]


def unit_bounds(meta: LeRobotDatasetMetadata, key: str, mode: Any) -> Tensor:
    """(2, S) values of a feature that LeRobot normalises to -1 and 1."""
    assert meta.stats is not None
    (size,) = meta.features[key]["shape"]
    return torch.tensor(np.stack(bounds(meta.stats[key], mode, size)), dtype=torch.float32)
