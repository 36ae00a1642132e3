"""Pointing of ``vla0_smol`` before its actions: where stone and place are, and the way to the place.

Shapes: `B` batch, `S` state dims, `J` numbers of what is pointed at.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from lerobot.datasets import LeRobotDatasetMetadata
from torch import Tensor

from lerobot_bomb.actions.bins import Bins
from lerobot_bomb.bomb.pointing import PointedAt
from lerobot_bomb.data.columns import present_episodes, read_columns
from lerobot_bomb.policies.pointing import (
    OTHER_PLACES,
    PLACE,
    RARE,
    STONE,
    DataUnits,
    MetricLabels,
)
from lerobot_policy_bomb.vla0_smol.configuration_vla0_smol import Vla0SmolConfig

# x and y of the stone, of the place, of the way from the gripper to the place
NUM_NUMBERS = 6
STONE_NUMBERS, PLACE_NUMBERS, WAY_NUMBERS = slice(0, 2), slice(2, 4), slice(4, 6)


class TextPointer(DataUnits):
    """Labels of a dataset as numbers of an answer, in bins of metres."""

    def __init__(self, config: Vla0SmolConfig):
        assert config.action_feature is not None
        super().__init__(config.action_feature.shape[0], config.normalization_mapping["ACTION"])
        self._range_m = config.pointing_range_m
        self._bins = Bins(config.n_action_bins, config.bin_mode)

    def labels(
        self, batch: dict[str, Any], other_share: float, policy_type: str, generator: torch.Generator
    ) -> MetricLabels:
        """Read a batch's labels and draw the given places; actions are as LeRobot normalises them."""
        labels = MetricLabels.read(batch, other_share, policy_type, self.state_bounds.device, generator)
        return replace(labels, other_actions=self.normalised(labels.other_actions))

    def bins_of(self, labels: MetricLabels, state_BS: Tensor) -> Tensor:
        """Return the bins (B, J) int64 of stone and place that are meant, and of the way to the given place.

        Longer ways, and stones farther away, are cut to the range.
        """
        way_B2 = labels.given_xy - self.gripper(state_BS)[:, :2]
        return self._bins.encode(torch.cat([labels.stone_xy, labels.place_xy, way_B2], dim=1) / self._range_m)

    def pointed_at(self, bins_J: Tensor) -> PointedAt:
        """(J,) int64 written bins -> what is pointed at, in metres."""
        metres_J = (self._bins.decode(bins_J) * self._range_m).double().cpu().numpy()
        return PointedAt(place_xy=metres_J[PLACE_NUMBERS], stone_xy=metres_J[STONE_NUMBERS])

    @staticmethod
    def loss_mask(labels: MetricLabels) -> Tensor:
        """Return (B, J) bool; ways to other places are left out, because no observation tells them."""
        loss_mask_BJ = torch.ones(len(labels.is_other), NUM_NUMBERS, dtype=torch.bool).to(labels.is_other)
        loss_mask_BJ[:, WAY_NUMBERS] = ~labels.is_other[:, None]
        return loss_mask_BJ

    def error_parts(self, errors_BJ: Tensor, counted_BJ: Tensor) -> dict[str, tuple[Tensor, Tensor]]:
        """Return absolute errors of decoded bins in metres, as `means` takes them."""
        parts = {"stone_l1_m": STONE_NUMBERS, "place_l1_m": PLACE_NUMBERS}
        return {
            name: (errors_BJ[:, part] * self._range_m, counted_BJ[:, part]) for name, part in parts.items()
        }

    def check(self, meta: LeRobotDatasetMetadata, config: Vla0SmolConfig) -> None:
        """Check that a dataset can be trained on.

        Raises:
            ValueError: the dataset has no pointing labels, or some are out of range.
        """
        config.require_labels(meta)
        columns = read_columns(meta, (PLACE, STONE, OTHER_PLACES), present_episodes(meta))
        stones = columns[STONE][:, :2]
        farthest = {key: np.abs(columns[key]).max() for key in (PLACE, OTHER_PLACES)}
        farthest[STONE] = np.quantile(np.abs(stones).max(axis=1), 1 - RARE, method="higher")
        for key, farthest_m in farthest.items():
            if farthest_m > self._range_m:
                raise ValueError(
                    f"--policy.pointing_range_m={self._range_m}: {key} of {meta.repo_id} is up to "
                    f"{farthest_m:.3g} m from the origin in x or y; give at least that"
                )


def make_pointer(config: Vla0SmolConfig, meta: LeRobotDatasetMetadata | None) -> TextPointer | None:
    """Make the pointer; None without `pointing`."""
    if not config.pointing:
        return None
    pointer = TextPointer(config)
    if meta is not None:
        pointer.check(meta, config)
        pointer.fit_units(meta, config.normalization_mapping)
    return pointer
