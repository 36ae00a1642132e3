"""Base of policies that may point before they act."""

import torch
from torch import Tensor
from torch.nn.functional import cross_entropy

from lerobot_bomb.bomb.commands import INTERSECTIONS
from lerobot_bomb.policies.board_reader import BoardReader
from lerobot_bomb.policies.pointing import SPOTS
from lerobot_bomb.policies.pointing_config import PointingVlaConfig
from lerobot_bomb.policies.policy import VlaPolicy

# metrics as `lerobot_bomb.actions.accuracy.means` takes them
type Parts = dict[str, tuple[Tensor, Tensor]]

BOARD_READER = "board_reader"  # attribute; adapters' `modules_to_save`


class PointingVlaPolicy(VlaPolicy):
    """Policy whose image tokens have to tell where stones lie while it learns to point.

    Shapes: `B` batch, `P` image tokens of all cameras, `H` hidden size, `S` spots.
    """

    config_class = PointingVlaConfig  # pyright: ignore[reportAssignmentType]
    name = "pointing_vla"  # pyright: ignore[reportAssignmentType]
    config: PointingVlaConfig
    board_reader: BoardReader | None  # None: no board is read

    def _add_board_reader(self, hidden_size: int, tokens_per_image: int) -> None:
        """Make the board reader if configured. No action depends on it, so a checkpoint may lack it."""
        if not self.config.reads_board:
            self.board_reader, self.may_skip = None, (*self.may_skip, BOARD_READER)
            return
        self.board_reader = BoardReader(len(self._cameras) * tokens_per_image, hidden_size)
        self.may_lack = (*self.may_lack, BOARD_READER)

    @property
    def _other_share(self) -> float:
        """Share of frames that are given another place; evaluation is on the true ones."""
        return self.config.counterfactual_share if self.training else 0.0

    def _with_board(
        self, loss: Tensor, batch: dict[str, Tensor], features_BPH: Tensor
    ) -> tuple[Tensor, Parts]:
        """Add the loss of reading stones off image features to a loss, () or (B,); return its metrics."""
        if self.board_reader is None:
            return loss, {}
        colors_BS = self._of_batch(batch, SPOTS).long()
        logits_BSC = self.board_reader(features_BPH)
        losses_BS = cross_entropy(logits_BSC.transpose(1, 2), colors_BS, reduction="none")
        # the tray's squares are many and nearly all empty: a stone there counts as one on the board
        loss_B = losses_BS.sum(dim=1) / len(INTERSECTIONS)
        is_right_BS = logits_BSC.argmax(dim=2) == colors_BS
        return plus(loss, self.config.board_loss_weight, loss_B), {
            "board_loss": (loss_B.detach(), torch.ones_like(loss_B, dtype=torch.bool)),
            "board_accuracy": (is_right_BS, colors_BS > 0),  # of the stones
        }


def plus(loss: Tensor, weight: float, other_B: Tensor) -> Tensor:
    """Add a weighted loss of each row to a loss over all rows, (), or of each row, (B,)."""
    return loss + weight * (other_B if loss.ndim else other_B.mean())
