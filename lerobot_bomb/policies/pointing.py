"""Point, then act: which stone goes where, predicted first and read in training only.

A policy that has read a place right may still not go there, for demonstrations rarely force it to. So on some
of the frames it is given another place, and the expert's action for that one.

Shapes: `B` batch, `P` places, `K` actions of a chunk, `D` action dims.
"""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import OBS_PREFIX, OBS_STATE
from torch import Tensor

from lerobot_bomb.actions.grid_fit import EQUAL_BOUNDS
from lerobot_bomb.actions.relative import bounds
from lerobot_bomb.bomb.pointing import COLUMNS, NUM_OTHERS, PREFIX
from lerobot_bomb.data.columns import dim_names, present_episodes, read_columns
from lerobot_bomb.vlm.inputs import read_tensor

LABELS = f"{OBS_PREFIX}{PREFIX}"  # what the keys of a dataset's columns begin with
PLACE, STONE, OTHER_PLACES, OTHER_ACTIONS = (f"{OBS_PREFIX}{name}" for name in COLUMNS)
GRIPPER = ("x", "y", "z")  # dimensions of the state
SAME_PLACE_M = 1e-3


@dataclass
class PointingFlags:
    """What the config of a policy that can point has beside its other flags."""

    # as `ConfigWithEnvironment` has them
    LATER_FIELDS: ClassVar[dict[str, Any]] = {
        "pointing": False,
        "counterfactual_share": 0.5,
        "pointing_places": None,
    }

    # whether a place and a stone are predicted before the action; a dataset's columns are the labels
    pointing: bool = False
    # share of the frames that are given another place, and the expert's action for it
    counterfactual_share: float = 0.5
    # (x, y) in metres that can be pointed at; filled in
    pointing_places: list[list[float]] | None = None

    def check_counterfactual_share(self) -> None:
        if not 0 <= self.counterfactual_share <= 1:
            raise ValueError(f"--policy.counterfactual_share={self.counterfactual_share} must lie in 0..1")

    def pointing_method(self) -> list[str]:
        """As `ConfigWithEnvironment.methods`; none where the policy acts as its paper's."""
        return ["points before it acts"] if self.pointing else []

    def take_places(self, meta: LeRobotDatasetMetadata | None) -> list[list[float]]:
        """Return the checkpoint's places, or else the dataset's, which are filled in.

        Raises:
            ValueError: there is neither, or the dataset cannot be trained on.
        """
        if meta is not None:
            self.pointing_places = places_of(meta, self.pointing_places)
        if self.pointing_places is None:
            raise ValueError(
                "--policy.pointing=true takes the places from a dataset, and there is none; train on one "
                "that lerobot-bomb record --pointing wrote"
            )
        return self.pointing_places


@dataclass(frozen=True)
class Labels:
    """What a batch's frames point at, and the place that the heads are given."""

    place: Tensor  # (B,) int64, number of the place that is meant
    stone_xy: Tensor  # (B, 2) metres
    held: Tensor  # (B,) in [0, 1]
    is_other: Tensor  # (B,) bool, whether another place is given
    given: Tensor  # (B,) int64, number of the place that is given
    other_actions: Tensor  # (B, D) the expert's for another place, in the environment's units

    @classmethod
    def draw(
        cls,
        batch: dict[str, Any],
        places_P2: Tensor,
        other_share: float,
        policy_type: str,
        generator: torch.Generator,
    ) -> "Labels":
        """Read a batch; on a share of its frames, one of their other places is given."""
        device = places_P2.device

        def read(key: str) -> Tensor:
            return read_tensor(batch, key, policy_type, device).float()

        place_B, stone_B3 = number_of(read(PLACE), places_P2), read(STONE)
        drawn_B = torch.randint(NUM_OTHERS, (len(place_B),), generator=generator).to(device)
        is_other_B = (torch.rand(len(place_B), generator=generator) < other_share).to(device)
        row_B = torch.arange(len(place_B), device=device)
        other_xy_B2, other_actions_BD = (
            read(key).unflatten(1, (NUM_OTHERS, -1))[row_B, drawn_B] for key in (OTHER_PLACES, OTHER_ACTIONS)
        )
        given_B = torch.where(is_other_B, number_of(other_xy_B2, places_P2), place_B)
        return cls(place_B, stone_B3[:, :2], stone_B3[:, 2], is_other_B, given_B, other_actions_BD)

    def normalised(self, bounds_2D: Tensor) -> "Labels":
        """Labels whose other actions are as LeRobot normalises them; ``bounds_2D``: what -1 and 1 are."""
        low_D, high_D = bounds_2D
        width_D = torch.where(high_D == low_D, EQUAL_BOUNDS, high_D - low_D)
        return replace(self, other_actions=2 * (self.other_actions - low_D) / width_D - 1)

    def given_actions(self, actions_BKD: Tensor, kept_BK: Tensor, other_B1D: Tensor) -> tuple[Tensor, Tensor]:
        """Actions, and which of them are known, for the places that are given.

        ``other_B1D``: `other_actions`, as ``actions_BKD`` are. Of another place only the next one is known.
        """
        is_first_K = torch.arange(actions_BKD.shape[1], device=actions_BKD.device) == 0
        is_other_BK = self.is_other[:, None] & is_first_K
        actions_BKD = torch.where(is_other_BK[..., None], other_B1D, actions_BKD)
        return actions_BKD, kept_BK & (is_first_K | ~self.is_other[:, None])


def number_of(xy_B2: Tensor, places_P2: Tensor) -> Tensor:
    """(B,) int64: the nearest place to each."""
    return torch.cdist(xy_B2, places_P2).argmin(dim=1)


def places_of(meta: LeRobotDatasetMetadata, known: list[list[float]] | None) -> list[list[float]]:
    """(P, 2) metres: the places that a dataset points at, or those ``known``, if they are among them.

    Raises:
        ValueError: the dataset does not point, or at places that the checkpoint does not know.
    """
    missing = [key for key in (PLACE, STONE, OTHER_PLACES, OTHER_ACTIONS) if key not in meta.features]
    if missing:
        raise ValueError(
            f"--policy.pointing=true is trained on the columns {', '.join(missing)}, which {meta.repo_id} "
            "lacks; lerobot-bomb record --pointing writes them"
        )
    columns = read_columns(meta, (PLACE, OTHER_PLACES), present_episodes(meta))
    found = np.unique(np.concatenate([columns[key].reshape(-1, 2) for key in (PLACE, OTHER_PLACES)]), axis=0)
    if known is None:
        return found.astype(np.float64).round(6).tolist()
    apart_m = np.linalg.norm(found[:, None] - np.array(known), axis=-1).min(axis=1)
    if (apart_m > SAME_PLACE_M).any():
        raise ValueError(
            f"--policy.pointing=true: {meta.repo_id} points at {found[apart_m.argmax()].tolist()}, which is "
            "no place of this checkpoint; train one of its own"
        )
    return known


def gripper_dims(meta: LeRobotDatasetMetadata) -> list[int]:
    """Of x, y and z in the state."""
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
