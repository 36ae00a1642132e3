"""``fdvla`` as explanations score its answers: by minus their loss, under the same noise for all rows.

Shapes as in `modeling_fdvla`; `J` draws of noise and time.
"""

from typing import TYPE_CHECKING, ClassVar

import torch
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_bomb.explain.scored_policy import ANSWER, Batch, Rows, ScoredPromptPolicy, TokenSpan
from lerobot_bomb.flow.path import path_point

if TYPE_CHECKING:
    from lerobot_policy_bomb.fdvla.modeling_fdvla import FdvlaPolicy

NUM_DRAWS = 8  # of noise and time; times in the middle of as many equal parts of [0, 1]
SEED = 0
POINTING = "pointing"  # the pass that points


class ScoredFdvla(ScoredPromptPolicy):
    """Answers are chunks as the heads predict them, (1, K, D)."""

    policy: "FdvlaPolicy"
    unit: ClassVar[str] = "loss"

    def answer(self, batch: Batch) -> Tensor:
        with torch.no_grad():
            return self.policy.to_relative(self.policy.predict_action_chunk(batch, self._noise(1)), batch)

    def read(self, batch: Batch, ids_BL: Tensor) -> Rows:
        state = {} if self.policy.pointer is None else {OBS_STATE: batch[OBS_STATE]}
        return state | {"embeds": self.policy.embed(batch, ids_BL)}

    def score(self, rows: Rows, answer: Tensor) -> Tensor:
        num_rows, noise_JKD = len(rows["embeds"]), self._noise(NUM_DRAWS)
        tau_J = (torch.arange(NUM_DRAWS, device=answer.device) + 0.5) / NUM_DRAWS
        point = path_point(
            answer.expand(num_rows * NUM_DRAWS, -1, -1),
            noise_JKD.repeat(num_rows, 1, 1),
            tau_J.repeat(num_rows),
        )
        with self.policy.eval().autocast():
            loss_B = self.policy.chunk_loss(self.prompt(rows), rows["embeds"], rows.get(OBS_STATE), point)
        return -loss_B.unflatten(0, (num_rows, NUM_DRAWS)).mean(dim=1)

    def token_spans(self, rows: Rows) -> dict[str, TokenSpan]:
        """Return the token spans of the prompt, padding included, of pointing, and of noisy actions."""
        segments = [ANSWER] if self.policy.pointer is None else [POINTING, ANSWER]
        spans: dict[str, TokenSpan] = {
            part: (each, *[None] * len(segments)) for part, each in self.columns(rows).items()
        }
        return spans | {
            name: (None, *(slice(None) if each == name else None for each in segments)) for name in segments
        }

    def _noise(self, num_draws: int) -> Tensor:
        """Draw (J, K, D) standard normal, the same in every call."""
        shape = num_draws, self.policy.config.chunk_size, self.policy.action_dim
        noise_JKD = torch.randn(shape, generator=torch.Generator().manual_seed(SEED))
        return noise_JKD.to(self.policy.action_unit.device)
