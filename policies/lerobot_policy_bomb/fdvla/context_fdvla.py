"""Context that ``fdvla`` keeps of an observation. Shapes: `B` batch, `H` hidden size."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from lerobot_bomb.vlm.prefix import Prefix


@dataclass(frozen=True)
class Context:
    """An observation as every sampling step reads it."""

    prefix: Prefix
    pooled: Tensor  # (B, H)
    feedback: Tensor | None  # (B, H) of what was pointed at; None: nothing is

    def of_draws(self, number: int) -> "Context":
        """Return the heads' inputs, each observation repeated; the prefix is shared."""
        if number == 1:
            return self
        repeat = partial(torch.repeat_interleave, repeats=number, dim=0)
        feedback = None if self.feedback is None else repeat(self.feedback)
        return Context(self.prefix, repeat(self.pooled), feedback)

    def tensors(self) -> list[Tensor]:
        """Return all tensors, as `of` takes them."""
        return [self.pooled, *([] if self.feedback is None else [self.feedback]), *self.prefix.tensors()]

    @classmethod
    def of(cls, tensors: Sequence[Tensor], has_feedback: bool) -> "Context":
        """Invert `tensors`."""
        pooled, *rest = tensors
        return cls(Prefix.of(rest[has_feedback:]), pooled, rest[0] if has_feedback else None)
