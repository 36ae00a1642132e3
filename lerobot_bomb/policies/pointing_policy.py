"""The base of policies that may point before they act."""

import torch
from torch import Tensor
from torch.nn.functional import cross_entropy

from lerobot_bomb.policies.board_reader import BoardReader
from lerobot_bomb.policies.pointing import BOARD_COLORS
from lerobot_bomb.policies.pointing_config import PointingVlaConfig
from lerobot_bomb.policies.policy import VlaPolicy

# of metrics, as `lerobot_bomb.actions.accuracy.means` takes them
type Parts = dict[str, tuple[Tensor, Tensor]]

BOARD_READER = "board_reader"  # attribute; adapters' `modules_to_save`


class PointingVlaPolicy(VlaPolicy):
    """One whose image tokens have to tell what lies on the board while it learns to point.

    Shapes: `B` batch, `P` image tokens of all cameras, `H` hidden size, `I` intersections.
    """

    config_class = PointingVlaConfig  # pyright: ignore[reportAssignmentType]
    name = "pointing_vla"  # pyright: ignore[reportAssignmentType]
    config: PointingVlaConfig
    board_reader: BoardReader | None  # None: no board is read

    def _add_board_reader(self, hidden_size: int, tokens_per_image: int) -> None:
        """Make it if the config says so. A checkpoint may have it or not, for no answer depends on it."""
        if not self.config.reads_board:
            self.board_reader, self.may_skip = None, (*self.may_skip, BOARD_READER)
            return
        self.board_reader = BoardReader(len(self._cameras) * tokens_per_image, hidden_size)
        self.may_lack = (*self.may_lack, BOARD_READER)

    def _with_board(
        self, loss: Tensor, batch: dict[str, Tensor], features_BPH: Tensor
    ) -> tuple[Tensor, Parts]:
        """Add to a loss, () or (B,), that of reading the board off image features; return its metrics."""
        if self.board_reader is None:
            return loss, {}
        colors_BI = self._of_batch(batch, BOARD_COLORS).long()
        logits_BIC = self.board_reader(features_BPH)
        loss_B = cross_entropy(logits_BIC.transpose(1, 2), colors_BI, reduction="none").mean(dim=1)
        is_right_BI = logits_BIC.argmax(dim=2) == colors_BI
        return plus(loss, self.config.board_loss_weight, loss_B), {
            "board_loss": (loss_B.detach(), torch.ones_like(loss_B, dtype=torch.bool)),
            "board_accuracy": (is_right_BI, colors_BI > 0),  # of the stones
        }


def plus(loss: Tensor, weight: float, other_B: Tensor) -> Tensor:
    """Add another loss of each row, weighed, to a loss of them all, (), or of each, (B,)."""
    return loss + weight * (other_B if loss.ndim else other_B.mean())
