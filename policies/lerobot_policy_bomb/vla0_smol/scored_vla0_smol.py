"""``vla0_smol`` as explanations score its answers: by their log-probability, under the grammar."""

from typing import TYPE_CHECKING

from torch import Tensor

from lerobot_bomb.explain.scored_policy import ANSWER, Batch, Rows, ScoredTokenPolicy, TokenSpan

if TYPE_CHECKING:
    from lerobot_policy_bomb.vla0_smol.modeling_vla0_smol import Vla0SmolPolicy


class ScoredVla0Smol(ScoredTokenPolicy):
    """Answers are the numbers of a whole chunk, (1, N)."""

    policy: "Vla0SmolPolicy"

    def read(self, batch: Batch, ids_BL: Tensor) -> Rows:
        return {"features": self.policy.encode_images(batch)}

    def score(self, rows: Rows, answer: Tensor) -> Tensor:
        numbers_BN = answer.expand(len(rows["ids"]), -1)
        with self.policy.eval().autocast():
            return self.policy.log_probability(rows["features"], self.prompt(rows), numbers_BN)

    def token_spans(self, rows: Rows) -> dict[str, TokenSpan]:
        """Return the spans in one pass, without padding."""
        index_L = rows["mask"][0].cumsum(dim=0) - 1
        spans: dict[str, TokenSpan] = {part: (index_L[each],) for part, each in self.columns(rows).items()}
        # the prompt's last token predicts the answer's first; rows of one answer have no padding
        return spans | {ANSWER: (slice(int(index_L[-1]), None),)}
