"""Flags of policies that may point before they act."""

from dataclasses import dataclass
from typing import Any, ClassVar

from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_bomb.policies.config import VlaConfig
from lerobot_bomb.policies.pointing import places_of, require_labels
from lerobot_bomb.training.policy_flags import check_not_negative


@dataclass
class PointingVlaConfig(VlaConfig):
    """Config of a policy that predicts which stone goes where, and then acts on its prediction."""

    # see `ConfigWithEnvironment`
    LATER_FIELDS: ClassVar[dict[str, Any]] = {
        **VlaConfig.LATER_FIELDS,
        "pointing": False,
        "counterfactual_share": 0.5,
        "board_loss_weight": 1.0,
        "pointing_loss_weight": 1.0,
    }

    # predict a place and a stone first, then the actions; the labels are columns of record --pointing
    pointing: bool = False
    # share of the training frames that get another place, with the expert's action for it
    counterfactual_share: float = 0.5
    # weight of the loss of reading the board off image tokens; 0: off, and the dataset needs no such column
    board_loss_weight: float = 1.0
    # weight of the loss of pointing; of tokens: of each, beside those of the actions
    pointing_loss_weight: float = 1.0

    def check_flags(self) -> None:
        super().check_flags()
        if not 0 <= self.counterfactual_share <= 1:
            raise ValueError(f"--policy.counterfactual_share={self.counterfactual_share} must lie in 0..1")
        check_not_negative(self, ("board_loss_weight", "pointing_loss_weight"))

    @property
    def reads_board(self) -> bool:
        """Return True if training also reads what lies on the board."""
        return self.pointing and self.board_loss_weight > 0

    def require_labels(self, meta: LeRobotDatasetMetadata) -> None:
        """Raise a ValueError unless a dataset has the columns for training this pointing."""
        require_labels(meta, reads_board=self.reads_board)

    def methods(self) -> list[str]:
        return [*super().methods(), *(["stone and destination predicted first"] if self.pointing else [])]


@dataclass
class PlacesVlaConfig(PointingVlaConfig):
    """Config of a policy that points at the places of a fixed table."""

    LATER_FIELDS: ClassVar[dict[str, Any]] = {**PointingVlaConfig.LATER_FIELDS, "pointing_places": None}

    # (x, y) in metres of the places to which it can point
    pointing_places: list[list[float]] | None = None

    def take_places(self, meta: LeRobotDatasetMetadata | None) -> list[list[float]]:
        """Fill in the dataset's places unless the checkpoint has some, and return them.

        Raises:
            ValueError: neither has places, or the dataset cannot be trained on.
        """
        if meta is not None:
            self.require_labels(meta)
            self.pointing_places = places_of(meta, self.pointing_places)
        if self.pointing_places is None:
            raise ValueError(
                "--policy.pointing=true takes the places from a dataset, and there is none; train on one "
                "that lerobot-bomb record --pointing wrote"
            )
        return self.pointing_places
