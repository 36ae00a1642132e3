"""``spatialvla_grid`` as explanations score its answers: by the log-probability of their cells."""

from typing import TYPE_CHECKING

from torch import Tensor

from lerobot_bomb.explain.scored_policy import ANSWER, Batch, Rows, ScoredTokenPolicy, TokenSpan

if TYPE_CHECKING:
    from lerobot_policy_bomb.spatialvla_grid.modeling_spatialvla_grid import SpatialvlaGridPolicy


class ScoredSpatialvlaGrid(ScoredTokenPolicy):
    """Answers are the pointing tokens and those of a whole chunk, (1, S)."""

    policy: "SpatialvlaGridPolicy"

    def read(self, batch: Batch, ids_BL: Tensor) -> Rows:
        return {"embeds": self.policy.embed(ids_BL, self.policy.encode_images(batch))}

    def score(self, rows: Rows, answer: Tensor) -> Tensor:
        answer_BS = answer.expand(len(rows["embeds"]), -1)
        with self.policy.eval().autocast():
            return self.policy.log_probability(self.prompt(rows), rows["embeds"], answer_BS)

    def token_spans(self, rows: Rows) -> dict[str, TokenSpan]:
        """Return the spans in one pass, padding included."""
        num_columns = rows["mask"].shape[1]
        spans: dict[str, TokenSpan] = {part: (each,) for part, each in self.columns(rows).items()}
        return spans | {ANSWER: (slice(num_columns - 1, None),)}
