"""``spatialvla_grid`` as explanations ask it: the log-probability of cells.

Shapes as in `modeling_spatialvla_grid`.
"""

from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

from lerobot_bomb.bomb.pointing import PointedAt
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
    """Answers are the tokens of a whole chunk, and what is pointed at ahead of them, (1, S)."""

    unit: ClassVar[str] = "nats"

    def __init__(self, policy: "SpatialvlaGridPolicy"):
        check_greedy(policy.config.temperature)
        self._policy = policy
        self.layers = decoder_layers(policy.backbone.text_model)

    def answer(self, batch: Batch) -> Tensor:
        return self._policy._write(batch, self._policy.config.chunk_size)

    def encode(self, batch: Batch) -> Rows:
        policy = self._policy.eval()
        with policy._autocast():
            rows = self.prompt(policy._prompt_parts(batch))
            return rows | {"embeds": policy._embeds(batch, rows["ids"])}

    def score(self, rows: Rows, answer: Tensor) -> Tensor:
        policy = self._policy.eval()
        answer_BS = answer.expand(len(rows["embeds"]), -1)
        pointed_BN, cells_BTG = policy._split(answer_BS)
        with policy._autocast():
            pointing_BNH, hidden_BTGH = policy._hidden_after(self.tokens(rows), rows["embeds"], answer_BS)
            score_B = self._log_probability(policy._group_rows, hidden_BTGH, cells_BTG)
            if policy.pointer is None:
                return score_B
            as_step = pointing_BNH[:, None], pointed_BN[:, None]
            return score_B + self._log_probability(policy._pointing_rows, *as_step)

    def pointed(self, batch: Batch) -> PointedAt | None:
        policy = self._policy.eval()
        if policy.pointer is None:
            return None
        answer_1S, rows = self.answer(batch), self.encode(batch)
        with torch.no_grad(), policy._autocast():
            pointing_1NH, _ = policy._hidden_after(self.tokens(rows), rows["embeds"], answer_1S)
            logits_1P = policy._logits(policy._pointing_rows[0], pointing_1NH[:, 0]).float()
        pointed_1N, _ = policy._split(answer_1S)
        return policy.pointer.pointed_at(pointed_1N[0], logits_1P[0].softmax(dim=0))

    def _log_probability(self, rows: list[slice], hidden_BTGH: Tensor, tokens_BTG: Tensor) -> Tensor:
        """(B,) of tokens, whose rows may be chosen in each of G slots."""
        chosen = [
            self._policy._logits(slot, hidden_BTGH[:, :, i])
            .float()
            .log_softmax(dim=-1)
            .gather(-1, tokens_BTG[:, :, i, None])
            for i, slot in enumerate(rows)
        ]
        return torch.cat(chosen, dim=-1).sum(dim=(1, 2))

    def places(self, rows: Rows) -> dict[str, Place]:
        """Return the places in one pass, padding included."""
        num_columns = rows["mask"].shape[1]
        places: dict[str, Place] = {name: (each,) for name, each in self.columns(rows).items()}
        return places | {ANSWER: (slice(num_columns - 1, None),)}
