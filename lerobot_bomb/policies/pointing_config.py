"""The flags of policies that may point before they act."""

from dataclasses import dataclass
from typing import Any, ClassVar

from lerobot_bomb.policies.config import VlaConfig


@dataclass
class PointingVlaConfig(VlaConfig):
    """Config of a policy that says which stone goes where, and then acts on what it has said."""

    # as `ConfigWithEnvironment` has them
    LATER_FIELDS: ClassVar[dict[str, Any]] = {"pointing": False, "counterfactual_share": 0.5}

    # whether a place and a stone are predicted first and actions follow; a dataset's columns are the labels
    pointing: bool = False
    # share of the training frames that are given another place, and the expert's action for it
    counterfactual_share: float = 0.5

    def check_flags(self) -> None:
        super().check_flags()
        if not 0 <= self.counterfactual_share <= 1:
            raise ValueError(f"--policy.counterfactual_share={self.counterfactual_share} must lie in 0..1")

    def methods(self) -> list[str]:
        return [*super().methods(), *(["points first"] if self.pointing else [])]
