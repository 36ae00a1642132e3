"""``vla0_smol`` as explanations ask it: the log-probability of an answer, under its grammar.

Shapes as in `modeling_vla0_smol`; `S` symbols.
"""

from typing import TYPE_CHECKING, ClassVar

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
from lerobot_policy_vla0_smol.pointing_vla0_smol import NUM_NUMBERS

if TYPE_CHECKING:
    from lerobot_policy_vla0_smol.modeling_vla0_smol import Vla0SmolPolicy


class ExplainedVla0Smol(PromptExplained):
    """Answers are the numbers of a whole chunk, (1, N)."""

    unit: ClassVar[str] = "nats"

    def __init__(self, policy: "Vla0SmolPolicy"):
        check_greedy(policy.config.temperature)
        self._policy = policy
        self.layers = decoder_layers(policy.backbone.text_model)

    def answer(self, batch: Batch) -> Tensor:
        return self._policy._write(batch, self._policy.config.chunk_size)

    def encode(self, batch: Batch) -> Rows:
        policy = self._policy.eval()
        with policy._autocast():
            return self.prompt(policy._prompt_parts(batch)) | {"features": policy._see(batch)}

    def score(self, rows: Rows, answer: Tensor) -> Tensor:
        policy = self._policy.eval()
        numbers_BN = answer.expand(len(rows["ids"]), -1)
        written = policy._answer(policy._to_tokens(numbers_BN, policy.config.n_action_bins)).rows
        with policy._autocast():
            hidden_BAH = policy._answer_hidden(rows["features"], self.tokens(rows), written)
            logits_BAS = policy.backbone.head(policy.symbol_ids)(hidden_BAH)
        symbol_BA = (written.ids[..., None] == policy.symbol_ids).long().argmax(dim=-1)
        grammar = policy.grammar
        # the space that every answer begins with is not chosen
        places = grammar.walk(grammar.start(len(symbol_BA)), symbol_BA[:, 1:-1])
        logits_BAS = logits_BAS[:, 1:].float() + grammar.logit_bias(places)
        chosen_BA1 = logits_BAS.log_softmax(dim=-1).gather(-1, symbol_BA[:, 1:, None])
        return chosen_BA1.sum(dim=(1, 2))

    def pointed(self, batch: Batch) -> PointedAt | None:
        pointer = self._policy.pointer
        return None if pointer is None else pointer.pointed_at(self.answer(batch)[0, :NUM_NUMBERS])

    def places(self, rows: Rows) -> dict[str, Place]:
        """Return the places in one pass, from which the padding is taken out."""
        index_L = rows["mask"][0].cumsum(dim=0) - 1
        places: dict[str, Place] = {name: (index_L[each],) for name, each in self.columns(rows).items()}
        # the prompt's last token predicts the answer's first; rows of one answer have no padding
        return places | {ANSWER: (slice(int(index_L[-1]), None),)}
