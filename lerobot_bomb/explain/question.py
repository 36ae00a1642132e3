"""Question about one moment: how far does the score of a policy's answer drop when its input changes?

The effect of a change is the score of the clean answer before minus after it (seed study of BOMB, E_patch and
E_text): positive where the changed input spoke for the answer.

Shapes: `M` changes, `S` tokens of an instruction, `H`, `W` of an image in pixels.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from lerobot_bomb.explain.images import occluded
from lerobot_bomb.explain.scored_policy import Batch, Rows, ScoredPolicy, repeated, scores_of

BATCH_SIZE = 64  # rows of a forward pass


class Question:
    """One observation of one episode, and a policy's answer to it.

    Images that are the same in all rows of a question go through the vision model once.
    """

    def __init__(
        self,
        policy: ScoredPolicy,
        prepare: Callable[[Batch], Batch],
        observation: Batch,
        batch_size: int = BATCH_SIZE,
    ):
        """``observation``: of one row, images in [0, 1], as ``prepare``, the preprocessor, takes it."""
        self.policy, self.observation = policy, observation
        self._prepare, self._batch_size = prepare, batch_size
        batch = prepare(observation)
        self.answer = policy.answer(batch)
        with torch.no_grad():
            self.rows = policy.encode(batch)
        self.clean_score = float(scores_of(policy, self.rows, self.answer, batch_size))

    @torch.no_grad()
    def encode(self, changes: Batch, times: int) -> Rows:
        """Encode copies of the observation with these values replaced, as the decoder reads them."""
        return self.policy.encode(self._prepare({**repeated(self.observation, times), **changes}))

    def effects(self, rows: Rows) -> Tensor:
        """(M,) effects of what each row reads in place of the observation."""
        return self.clean_score - scores_of(self.policy, rows, self.answer, self._batch_size)

    def effects_of_images(self, changed: dict[str, Tensor]) -> Tensor:
        """(M,) effects of other images (M, 3, H, W), by key."""
        return self.effects(self.encode(changed, len(next(iter(changed.values())))))

    def effects_of_masks(self, key: str, masks_MHW: Tensor, filling_3HW: Tensor) -> Tensor:
        """(M,) effects of taking parts out of one camera's image."""
        (image_3HW,) = self.observation[key]
        parts = masks_MHW.split(self._batch_size)
        images = (occluded(image_3HW, part, filling_3HW) for part in parts)
        return torch.cat([self.effects_of_images({key: each}) for each in images])

    def effects_of_hidden(self, hidden_MS: Tensor) -> Tensor:
        """(M,) effects of hiding tokens of the instruction from all others."""
        return self.effects(self.policy.hide(self.rows, hidden_MS))

    def effects_of_instructions(self, instructions: Sequence[str]) -> Tensor:
        """(M,) effects of other instructions."""
        return self.effects(self.encode({"task": [*instructions]}, len(instructions)))
