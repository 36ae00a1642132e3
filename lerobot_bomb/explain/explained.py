"""A policy as an explanation asks it: how strongly does it hold to its clean answer?

The answer is the one to what the policy really saw, and stays fixed; what is read, or what is computed on the
way, is changed. A higher score means that the answer is more likely or closer.

Shapes: `B` rows, `S` tokens of an instruction, `K` actions of a chunk, `D` action dims.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK
from torch import Tensor, nn
from torch.nn.functional import pad

from lerobot_bomb.actions.text import TokenRows
from lerobot_bomb.bomb.pointing import PointedAt
from lerobot_bomb.vlm.inputs import OBS_LANGUAGE_HIDDEN

type Batch = dict[str, Any]  # what a policy's preprocessor gives
type Rows = dict[str, Tensor]  # what `Explained.encode` makes of it; (B, ...) each
# columns of a sequence in each pass through the decoder of one score; None: it has none in this pass
type Place = tuple[Tensor | slice | None, ...]

INSTRUCTION, ANSWER = "instruction", "answer"


@dataclass(frozen=True)
class DecoderLayer:
    """A layer of the language model, and its parts."""

    # whose output are the states; None where the policy calls the parts one by one
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


class Explained(ABC):
    """A policy that scores its own answers.

    Scores of a row do not depend on the others of its batch, but for rounding.
    """

    unit: ClassVar[str]  # of a score
    # of the language model; [] where the policy has none, or none that is known
    layers: Sequence[DecoderLayer] = ()

    @abstractmethod
    def answer(self, batch: Batch) -> Tensor:
        """Return the policy's answer to a batch of one row, (1, ...)."""

    @abstractmethod
    def encode(self, batch: Batch) -> Rows:
        """Return what the decoder reads; images have gone through the vision model."""

    @abstractmethod
    def score(self, rows: Rows, answer: Tensor) -> Tensor:
        """(B,) float32 of one answer, (1, ...), given what each row reads."""

    @abstractmethod
    def hide(self, rows: Rows, hidden_BS: Tensor) -> Rows:
        """One row -> B rows in which no other token reads these of the instruction.

        Raises:
            ValueError: the policy reads no instruction.
        """

    @abstractmethod
    def hide_in(self, batch: Batch, hidden_S: Tensor) -> Batch:
        """A batch of one row, in which the policy answers without these tokens of the instruction.

        Raises:
            ValueError: the policy reads no instruction.
        """

    def pointed(self, batch: Batch) -> PointedAt | None:
        """Return what the policy points at before it answers a batch of one row; None: it does not."""
        return None

    def places(self, rows: Rows) -> dict[str, Place]:
        """Return where a row's images, instruction, state and answer stand in the decoder's sequences.

        ``instruction`` has a column for each of its tokens. {} where it is not known.
        """
        return {}


class PromptExplained(Explained):
    """One of our policies, whose prompt has parts.

    Rows hold ``ids``, ``mask`` and ``part``, and ``hidden`` where any token is, (B, L) each.
    """

    _names: Sequence[str] = ()  # of the parts

    def prompt(self, parts: Mapping[str, TokenRows]) -> Rows:
        """Join the parts to a prompt's rows; ``part`` is the number of the part that a column belongs to."""
        self._names = [*parts]
        numbers = [torch.full_like(part.ids, number) for number, part in enumerate(parts.values())]
        prompt = TokenRows.join([*parts.values()])
        rows = {"ids": prompt.ids, "mask": prompt.mask, "part": torch.cat(numbers, dim=1)}
        return rows if prompt.hidden is None else rows | {"hidden": prompt.hidden}

    @staticmethod
    def tokens(rows: Rows) -> TokenRows:
        """The prompt of rows."""
        return TokenRows(rows["ids"], rows["mask"], rows.get("hidden"))

    def of_part(self, rows: Rows, name: str) -> Tensor:
        """(B, L) bool, which columns belong to a part of the prompt, padding included."""
        return rows["part"] == self._names.index(name)

    def hide(self, rows: Rows, hidden_BS: Tensor) -> Rows:
        rows = {key: value.expand(len(hidden_BS), *value.shape[1:]) for key, value in rows.items()}
        columns = self.of_part(rows, INSTRUCTION)[0].nonzero()[: hidden_BS.shape[1], 0]  # then padding
        hidden_BL = rows["mask"] & ~self.tokens(rows).readable
        hidden_BL[:, columns] |= hidden_BS.to(hidden_BL.device)
        return rows | {"hidden": hidden_BL}

    def hide_in(self, batch: Batch, hidden_S: Tensor) -> Batch:
        mask_1S = batch[OBS_LANGUAGE_ATTENTION_MASK]
        hidden_1S = pad(hidden_S, (0, mask_1S.shape[1] - len(hidden_S)))[None].to(mask_1S.device)
        return {**batch, OBS_LANGUAGE_HIDDEN: hidden_1S}

    def columns(self, rows: Rows) -> dict[str, Tensor]:
        """Return the columns of each part in one row's prompt, without padding."""
        mask_L = rows["mask"][0]
        return {name: (self.of_part(rows, name)[0] & mask_L).nonzero()[:, 0] for name in self._names}


def repeated(values: Batch, times: int) -> Batch:
    """A batch of one row -> the same row so many times."""
    return {
        key: value.expand(times, *value.shape[1:])
        if isinstance(value, Tensor) and value.ndim and len(value) == 1
        else times * value
        if isinstance(value, list)
        else value
        for key, value in values.items()
    }


def some(rows: Rows, start: int, stop: int) -> Rows:
    """The rows from ``start`` up to ``stop``."""
    return {key: value[start:stop] for key, value in rows.items()}


@torch.no_grad()
def scores_of(explained: Explained, rows: Rows, answer: Tensor, batch_size: int) -> Tensor:
    """(B,) scores, so many rows at once."""
    num_rows = len(next(iter(rows.values())))
    parts = [
        explained.score(some(rows, start, start + batch_size), answer)
        for start in range(0, num_rows, batch_size)
    ]
    return torch.cat(parts)


def check_greedy(temperature: float) -> None:
    """Raise a ValueError if a policy's answers are samples."""
    if temperature:
        raise ValueError(
            f"--policy.temperature={temperature}: an explanation is of the likeliest answer; give "
            "--policy.temperature=0"
        )
