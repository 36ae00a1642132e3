"""``fdvla`` as explanations ask it: minus the loss of a chunk, under noise that is the same for all rows.

Shapes as in `modeling_fdvla`; `J` draws of noise and time.
"""

from typing import TYPE_CHECKING, ClassVar

import torch
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_bomb.bomb.pointing import PointedAt
from lerobot_bomb.explain.explained import (
    ANSWER,
    INSTRUCTION,
    Batch,
    Place,
    PromptExplained,
    Rows,
    decoder_layers,
)
from lerobot_bomb.flow.losses import joint_loss
from lerobot_bomb.flow.path import path_point

if TYPE_CHECKING:
    from lerobot_policy_fdvla.modeling_fdvla import FdvlaPolicy

NUM_DRAWS = 8  # of noise and time; times in the middle of as many equal parts of [0, 1]
SEED = 0
POINTING = "pointing"  # the pass that points


class ExplainedFdvla(PromptExplained):
    """Answers are chunks as the heads predict them, (1, K, D)."""

    unit: ClassVar[str] = "loss"

    def __init__(self, policy: "FdvlaPolicy"):
        self._policy = policy
        self.layers = decoder_layers(policy.backbone.text_model)

    def answer(self, batch: Batch) -> Tensor:
        policy = self._policy
        with torch.no_grad():
            return policy._to_relative(policy.predict_action_chunk(batch, self._noise(1)), batch)

    def encode(self, batch: Batch) -> Rows:
        policy = self._policy.eval()
        with policy._autocast():
            rows = self.prompt(policy._prompt_parts(batch))
            state = {} if policy.pointer is None else {OBS_STATE: policy._of_batch(batch, OBS_STATE)}
            return rows | state | {"embeds": policy._embeds(batch, rows["ids"])}

    def score(self, rows: Rows, answer: Tensor) -> Tensor:
        policy, config = self._policy.eval(), self._policy.config
        num_rows, noise_JKD = len(rows["embeds"]), self._noise(NUM_DRAWS)
        tau_J = (torch.arange(NUM_DRAWS, device=answer.device) + 0.5) / NUM_DRAWS
        point = path_point(
            answer.expand(num_rows * NUM_DRAWS, -1, -1),
            noise_JKD.repeat(num_rows, 1, 1),
            tau_J.repeat(num_rows),
        )
        prompt = self.tokens(rows)
        is_task_BL = prompt.readable & self.of_part(rows, INSTRUCTION)
        with policy._autocast():
            context = policy._context(prompt, is_task_BL, rows["embeds"])
            if policy.pointer is not None:
                context = policy._pointing(context, rows[OBS_STATE])
            kept = torch.ones(point.actions.shape[:2], dtype=torch.bool, device=answer.device)
            predicted = policy._heads(context, kept)(point.actions, point.tau)
        velocity_BKD, noise_BKD = (None if values is None else values.float() for values in predicted)
        loss_B, _ = joint_loss(
            velocity_BKD,
            noise_BKD,
            point,
            kept,
            flow_loss_weight=config.flow_loss_weight,
            denoise_loss_weight=config.denoise_loss_weight,
            consistency="none",
            reduction="none",
        )
        return -loss_B.unflatten(0, (num_rows, NUM_DRAWS)).mean(dim=1)

    def pointed(self, batch: Batch) -> PointedAt | None:
        policy = self._policy.eval()
        if policy.pointer is None:
            return None
        with torch.no_grad(), policy._autocast():
            pointed = policy._point(policy._read(batch), policy._of_batch(batch, OBS_STATE))
            return policy.pointer.pointed_at(pointed)

    def places(self, rows: Rows) -> dict[str, Place]:
        """Return places in passes over the prompt, padding included, over what points, and noisy actions."""
        segments = [ANSWER] if self._policy.pointer is None else [POINTING, ANSWER]
        places: dict[str, Place] = {
            name: (each, *[None] * len(segments)) for name, each in self.columns(rows).items()
        }
        return places | {
            name: (None, *(slice(None) if each == name else None for each in segments)) for name in segments
        }

    def _noise(self, num_draws: int) -> Tensor:
        """(J, K, D) standard normal, the same in every call."""
        policy = self._policy
        shape = num_draws, policy.config.chunk_size, policy._action_dim
        return torch.randn(shape, generator=torch.Generator().manual_seed(SEED)).to(policy._device)
