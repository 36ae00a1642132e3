"""Policies that score their own answers.

The answer is the one to the true observation, and stays fixed; what the policy reads, or computes on the way,
is changed. A higher score means that the answer is more likely or closer.

Shapes: `B` rows, `L` tokens of a prompt, `S` of an instruction, `K` actions of a chunk, `D` action dims.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, Self

import torch
from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK
from torch import Tensor, nn
from torch.nn.functional import pad

from lerobot_bomb.actions.text import TokenRows
from lerobot_bomb.bomb.pointing import PointedAt
from lerobot_bomb.vlm.inputs import OBS_LANGUAGE_HIDDEN
from lerobot_bomb.vlm.layout import INSTRUCTION, PromptLayout

type Batch = dict[str, Any]  # output of a policy's preprocessor
type Rows = dict[str, Tensor]  # what `ScoredPolicy.encode` makes of it; (B, ...) each
# columns of a sequence in each pass through the decoder of one score; None: it has none in this pass
type TokenSpan = tuple[Tensor | slice | None, ...]

ANSWER = "answer"


@dataclass(frozen=True)
class DecoderLayer:
    """A layer of the language model, and its parts."""

    # its output is the states; None where the policy calls the parts one by one
    layer: nn.Module | None
    attention_out: nn.Module  # output projection; its input are the heads' outputs, side by side
    num_heads: int
    mlp: nn.Module


def decoder_layers(text_model: Any, *, called_whole: bool = True) -> list[DecoderLayer]:
    """Return the layers of a text model whose layers are named as Llama's."""
    num_heads = text_model.config.num_attention_heads
    return [
        DecoderLayer(layer if called_whole else None, layer.self_attn.o_proj, num_heads, layer.mlp)
        for layer in text_model.layers
    ]


class ScoredPolicy(ABC):
    """A policy that scores its own answers.

    A row's scores do not depend on the other rows of its batch, except for rounding.
    """

    unit: ClassVar[str]  # of a score
    # of the language model; [] where the policy has none, or none that is known
    layers: Sequence[DecoderLayer] = ()

    @abstractmethod
    def answer(self, batch: Batch) -> Tensor:
        """Return the policy's answer to a batch of one row, (1, ...)."""

    @abstractmethod
    def encode(self, batch: Batch) -> Rows:
        """Return the decoder's inputs; images have gone through the vision model."""

    @abstractmethod
    def score(self, rows: Rows, answer: Tensor) -> Tensor:
        """(B,) float32 scores of one answer (1, ...), given the inputs of each row."""

    @abstractmethod
    def hide(self, rows: Rows, hidden_BS: Tensor) -> Rows:
        """One row -> B rows, in each of which these tokens of the instruction are hidden from all others.

        Raises:
            ValueError: the policy reads no instruction.
        """

    @abstractmethod
    def hide_in(self, batch: Batch, hidden_S: Tensor) -> Batch:
        """Change a batch of one row so that the policy answers without these tokens of the instruction.

        Raises:
            ValueError: the policy reads no instruction.
        """

    def pointed(self, batch: Batch) -> PointedAt | None:
        """Return what the policy points at before it answers a batch of one row; None if it does not."""
        return None

    def token_spans(self, rows: Rows) -> dict[str, TokenSpan]:
        """Return the spans of a row's images, instruction, state and answer in the decoder's sequences.

        ``instruction`` has a column for each of its tokens. {} where they are not known.
        """
        return {}


class PromptPolicy(Protocol):
    """Members of our policies that every score needs."""

    layout: PromptLayout
    backbone: Any

    def prompt(self, batch: Batch) -> TokenRows: ...
    def pointed(self, batch: Batch) -> PointedAt | None: ...
    def autocast(self) -> AbstractContextManager[None]: ...
    def eval(self) -> Self: ...


class ScoredPromptPolicy(ScoredPolicy):
    """One of our policies, whose prompt has a layout.

    Rows hold the prompt as ``ids`` and ``mask``, and ``hidden`` where any token is, (B, L) each.
    """

    policy: PromptPolicy

    def __init__(self, policy: PromptPolicy):
        self.policy = policy
        self.layers = decoder_layers(policy.backbone.text_model)

    @abstractmethod
    def read(self, batch: Batch, ids_BL: Tensor) -> Rows:
        """Return the decoder's inputs from a batch, except the prompt's tokens."""

    def encode(self, batch: Batch) -> Rows:
        with self.policy.eval().autocast():
            prompt = self.policy.prompt(batch)
            rows = {"ids": prompt.ids, "mask": prompt.mask, **self.read(batch, prompt.ids)}
        return rows if prompt.hidden is None else rows | {"hidden": prompt.hidden}

    def pointed(self, batch: Batch) -> PointedAt | None:
        return self.policy.pointed(batch)

    @staticmethod
    def prompt(rows: Rows) -> TokenRows:
        """Return the prompt of rows."""
        return TokenRows(rows["ids"], rows["mask"], rows.get("hidden"))

    def hide(self, rows: Rows, hidden_BS: Tensor) -> Rows:
        rows = {key: value.expand(len(hidden_BS), *value.shape[1:]) for key, value in rows.items()}
        first = self.policy.layout.spans(rows["ids"].shape[1])[INSTRUCTION].start
        hidden_BL = rows["mask"] & ~self.prompt(rows).attention_mask
        # the instruction's tokens stand before its padding
        hidden_BL[:, first : first + hidden_BS.shape[1]] |= hidden_BS.to(hidden_BL.device)
        return rows | {"hidden": hidden_BL}

    def hide_in(self, batch: Batch, hidden_S: Tensor) -> Batch:
        mask_1S = batch[OBS_LANGUAGE_ATTENTION_MASK]
        hidden_1S = pad(hidden_S, (0, mask_1S.shape[1] - len(hidden_S)))[None].to(mask_1S.device)
        return {**batch, OBS_LANGUAGE_HIDDEN: hidden_1S}

    def columns(self, rows: Rows) -> dict[str, Tensor]:
        """Return the columns of each part in one row's prompt, without padding."""
        mask_L = rows["mask"][0]
        spans = self.policy.layout.spans(len(mask_L))
        return {part: span.start + mask_L[span].nonzero()[:, 0] for part, span in spans.items()}


class TokenPolicy(PromptPolicy, Protocol):
    """Members of our policies of tokens that scores need besides."""

    config: Any

    def write(self, batch: Batch, num_steps: int) -> Tensor: ...


class ScoredTokenPolicy(ScoredPromptPolicy):
    """One of our policies whose answers are the tokens of a whole chunk, (1, S).

    A score is the answer's log-probability.

    Raises:
        ValueError: the policy's answers are samples.
    """

    policy: TokenPolicy
    unit: ClassVar[str] = "nats"

    def __init__(self, policy: TokenPolicy):
        if temperature := policy.config.temperature:
            raise ValueError(
                f"--policy.temperature={temperature}: an explanation is of the likeliest answer; give "
                "--policy.temperature=0"
            )
        super().__init__(policy)

    def answer(self, batch: Batch) -> Tensor:
        return self.policy.write(batch, self.policy.config.chunk_size)


def repeated(values: Batch, times: int) -> Batch:
    """A batch of one row -> the same row `times` times."""
    return {
        key: value.expand(times, *value.shape[1:])
        if isinstance(value, Tensor) and value.ndim and len(value) == 1
        else times * value
        if isinstance(value, list)
        else value
        for key, value in values.items()
    }


def some(rows: Rows, start: int, stop: int) -> Rows:
    """Return the rows from ``start`` up to ``stop``, which is left out."""
    return {key: value[start:stop] for key, value in rows.items()}


@torch.no_grad()
def scores_of(policy: ScoredPolicy, rows: Rows, answer: Tensor, batch_size: int) -> Tensor:
    """(B,) scores, computed in batches."""
    num_rows = len(next(iter(rows.values())))
    parts = [
        policy.score(some(rows, start, start + batch_size), answer)
        for start in range(0, num_rows, batch_size)
    ]
    return torch.cat(parts)
