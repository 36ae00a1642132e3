"""Activation patching of one moment: which layers, heads and MLPs bring back what a corruption takes away.

Shapes: `L` layers, `S` tokens of an instruction.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from lerobot_bomb.explain.activations import all_heads, all_layers, all_mlps
from lerobot_bomb.explain.images import occluded, patch_masks
from lerobot_bomb.explain.moment_query import MomentQuery, camera_name
from lerobot_bomb.explain.next_actions import NextActions
from lerobot_bomb.explain.question import Question
from lerobot_bomb.explain.restoration import Corruption
from lerobot_bomb.explain.scored_policy import INSTRUCTION, Batch, Rows, TokenSpan

PATCH, WORDS, OTHER_INSTRUCTION = "patch", "words", "other instruction"
OTHER_SCENE = "scene of another episode"  # its images and state, under this one's instruction


@dataclass(frozen=True)
class PatchingResult:
    """Result of activation patching: R (see `restoration`) of all units for a corruption, or NaN."""

    corruption: str
    drop: float  # of the score
    moved_mm: float | None  # how far the next action moves; None: as in Explanation
    places: dict[str, list[float]]  # by place in the sequence: (L,) of the layers' states there
    heads: list[list[float]]  # (L, heads)
    mlps: list[float]  # (L,)

    @property
    def measured(self) -> float:
        """Effect of the corruption as it is shown: in millimetres where these are known, else the drop."""
        return self.drop if self.moved_mm is None else self.moved_mm


@dataclass(frozen=True)
class CorruptInput:
    """Input of a moment with a part changed."""

    name: str
    changes: Batch  # values of the observation in place of its own
    hidden: Tensor | None = None  # (S,) bool, tokens of the instruction that no other reads

    def rows(self, question: Question) -> Rows:
        if self.hidden is None:
            return question.encode(self.changes, 1)
        return question.policy.hide(question.rows, self.hidden[None])


def corruptions(
    question: Question,
    query: MomentQuery,
    fillings: Mapping[str, Tensor],
    patches: Mapping[str, Tensor],
    words: Mapping[str, float],
    others: Mapping[str, float],
) -> list[CorruptInput]:
    """Return the strongest patch, span and other instruction, and another episode's scene."""
    if not question.policy.layers:
        return []
    found = []
    key = max(patches, key=lambda name: float(patches[name].max()))
    cell = int(patches[key].argmax())
    (image,) = question.observation[key]
    mask = patch_masks(query.grid, *image.shape[1:])[cell : cell + 1].to(image.device)
    name = f"{camera_name(key)} {PATCH} {cell // query.grid}, {cell % query.grid} taken out"
    found.append(CorruptInput(name, {key: occluded(image, mask, fillings[key])}))
    if words:
        span = max(query.spans, key=lambda each: words[each.name])
        found.append(CorruptInput(f"{WORDS} {span.name} hidden", {}, span.tokens(query.offsets)))
    if others:
        other = max(others, key=lambda each: others[each])
        corrupt = CorruptInput(
            f"{OTHER_INSTRUCTION}: {query.others[other]!r}", {"task": [query.others[other]]}
        )
        if _has_columns_of(corrupt.rows(question), question.rows):
            found.append(corrupt)
    if query.other_scene:
        found.append(CorruptInput(OTHER_SCENE, query.other_scene))
    return found


def _has_columns_of(rows: Rows, others: Rows) -> bool:
    """Return True if rows have as many tokens, and the same padding: states are put back token by token."""
    return all(
        value.shape == others[key].shape and (value.dtype != torch.bool or value.equal(others[key]))
        for key, value in rows.items()
    )


def _token_spans(question: Question, query: MomentQuery, rows: Rows) -> dict[str, TokenSpan]:
    """Return the spans of the prompt's parts and words; {} where the layers' states cannot be put back."""
    if any(layer.layer is None for layer in question.policy.layers):
        return {}
    spans = question.policy.token_spans(rows)
    first, *later = spans.get(INSTRUCTION, (None,))
    if not isinstance(first, Tensor):
        return spans
    words = {span.name: span.tokens(query.offsets) for span in query.spans}
    return spans | {name: (first[tokens], *later) for name, tokens in words.items()}


def restore(
    question: Question, query: MomentQuery, corrupt: CorruptInput, actions: NextActions | None
) -> PatchingResult:
    """Put each unit back into a corrupt input; with ``actions``, also measure the input in millimetres."""
    rows = corrupt.rows(question)
    corruption = Corruption(question, rows)
    layers = question.policy.layers
    by_span = {
        span: corruption.restore_each(all_layers(len(layers), columns)).tolist()
        for span, columns in _token_spans(question, query, rows).items()
    }
    heads = corruption.restore_each(all_heads(layers)).split([layer.num_heads for layer in layers])
    mlps = corruption.restore_each(all_mlps(len(layers)))
    return PatchingResult(
        corrupt.name,
        drop=question.clean_score - corruption.score,
        moved_mm=None if actions is None else actions.moved_mm(corrupt.changes, corrupt.hidden),
        places=by_span,
        heads=[each.tolist() for each in heads],
        mlps=mlps.tolist(),
    )
