"""Restoration of clean activations, one at a time: where in a language model does an input matter?

R(u) = (score with unit u put back - corrupt score) / (clean score - corrupt score), as in the study that BOMB
comes from: 1 where a unit brings back all of the clean answer's score, 0 where nothing of it.

Put back at all tokens, the output of any one layer gives 1, for all that follows is computed from it. A map
of layers is therefore by tokens, as in causal tracing (ROME, arXiv 2202.05262).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from lerobot_bomb.explain.activations import HEADS, MLP, PARTS, Activations, Unit, recording, restoring
from lerobot_bomb.explain.limits import smallest_drop
from lerobot_bomb.explain.question import BATCH_SIZE, Question
from lerobot_bomb.explain.scored_policy import Rows


@dataclass(frozen=True)
class Restoration:
    """Scores after units are put back into one corrupt input."""

    clean_score: float
    corrupt_score: float
    scores: Tensor  # (U,) with each of the units put back

    @property
    def is_defined(self) -> bool:
        """True if the corruption changed the score by more than rounding does."""
        return abs(self.clean_score - self.corrupt_score) > smallest_drop(self.clean_score)

    @property
    def ratios(self) -> Tensor:
        """(U,) R(u); NaN where it is not defined."""
        if not self.is_defined:
            return torch.full_like(self.scores, torch.nan)
        return (self.scores - self.corrupt_score) / (self.clean_score - self.corrupt_score)


class Corruption:
    """A question, and a row with some of its input changed."""

    def __init__(self, question: Question, rows: Rows):
        """``rows``: one row, which is read in place of the observation's."""
        self._question, self.rows = question, rows
        self._layers = question.policy.layers
        self.clean = self._record(question.rows)
        self.score = float(self._score(rows))

    @torch.no_grad()
    def _score(self, rows: Rows) -> Tensor:
        return self._question.policy.score(rows, self._question.answer)

    def _record(self, rows: Rows) -> Activations:
        parts = PARTS if all(layer.layer is not None for layer in self._layers) else (HEADS, MLP)
        with recording(self._layers, parts) as activations:
            self._score(rows)
        return activations

    def restore(self, units_of_rows: Sequence[Sequence[Unit]], batch_size: int = BATCH_SIZE) -> Restoration:
        """Put back the units of each row, in batches; nothing is encoded again."""
        return self._restore(self.clean, units_of_rows, batch_size)

    def restore_each(self, units: Sequence[Unit]) -> Tensor:
        """(U,) R of each unit."""
        return self.restore([[unit] for unit in units]).ratios

    def restore_corrupt(self, units_of_rows: Sequence[Sequence[Unit]]) -> Restoration:
        """Restore corrupt activations in place of the clean ones: every ratio is 0."""
        return self._restore(self._record(self.rows), units_of_rows, len(units_of_rows))

    def _restore(
        self, kept: Activations, units_of_rows: Sequence[Sequence[Unit]], batch_size: int
    ) -> Restoration:
        scores = []
        for start in range(0, len(units_of_rows), batch_size):
            part = units_of_rows[start : start + batch_size]
            rows = {key: value.expand(len(part), *value.shape[1:]) for key, value in self.rows.items()}
            with restoring(self._layers, kept, part):
                scores.append(self._score(rows))
        return Restoration(self._question.clean_score, self.score, torch.cat(scores))
