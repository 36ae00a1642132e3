"""``spatialvla_grid`` as explanations ask it: the log-probability of cells.

Shapes as in `modeling_spatialvla_grid`.
"""

from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

from lerobot_bomb.explain.explained import (
    ANSWER,
    Batch,
    Place,
    PromptExplained,
    Rows,
    check_greedy,
    decoder_layers,
)

if TYPE_CHECKING:
    from lerobot_policy_spatialvla_grid.modeling_spatialvla_grid import SpatialvlaGridPolicy


class ExplainedSpatialvlaGrid(PromptExplained):
    """Answers are the cells of a whole chunk, (1, T, G)."""

    unit: ClassVar[str] = "nats"

    def __init__(self, policy: "SpatialvlaGridPolicy"):
        check_greedy(policy.config.temperature)
        self._policy = policy
        self.layers = decoder_layers(policy.backbone.text_model)

    def answer(self, batch: Batch) -> Tensor:
        return self._policy._choose(batch, self._policy.config.chunk_size)

    def encode(self, batch: Batch) -> Rows:
        policy = self._policy.eval()
        with policy._autocast():
            rows = self.prompt(policy._prompt_parts(batch))
            return rows | {"embeds": policy._embeds(batch, rows["ids"])}

    def score(self, rows: Rows, answer: Tensor) -> Tensor:
        policy = self._policy.eval()
        cells_BTG = answer.expand(len(rows["embeds"]), -1, -1)
        with policy._autocast():
            hidden_BTGH = policy._hidden_after(self.tokens(rows), rows["embeds"], cells_BTG)
            chosen = [
                policy._cell_logits(group, hidden_BTGH[:, :, group])
                .float()
                .log_softmax(dim=-1)
                .gather(-1, cells_BTG[:, :, group, None])
                for group in range(cells_BTG.shape[2])
            ]
        return torch.cat(chosen, dim=-1).sum(dim=(1, 2))

    def places(self, rows: Rows) -> dict[str, Place]:
        """In one pass, padding included."""
        num_columns = rows["mask"].shape[1]
        places: dict[str, Place] = {name: (each,) for name, each in self.columns(rows).items()}
        return places | {ANSWER: (slice(num_columns - 1, None),)}
