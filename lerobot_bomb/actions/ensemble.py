"""Temporal ensemble: the mean of the actions that several chunks predicted for one step."""

from collections import deque
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import cosine_similarity

WEIGHTINGS = ("uniform", "exponential", "nvlabs", "adaptive")


def age_weights(weighting: str, num_chunks: int, coefficient: float) -> Tensor:
    """(num_chunks,) unnormalised weights of chunks, the newest first.

    ``uniform``: all alike (VLA-0, arXiv 2510.13054). ``exponential``: exp(coefficient * age), so a positive
    coefficient favours old chunks, as in ACT (arXiv 2304.13705), and -ln 2 halves the weight with every
    step of age. ``nvlabs``: 1 for the newest, 0.5 for all others, as VLA-0's published code does.
    """
    ages = torch.arange(num_chunks, dtype=torch.float32)
    if weighting == "uniform":
        return torch.ones(num_chunks)
    if weighting == "exponential":
        return torch.softmax(coefficient * ages, dim=0)  # cannot overflow; only the ratios matter
    return torch.where(ages == 0, 1.0, 0.5)


class TemporalEnsemble:
    """Weighted mean over the newest chunks, for a policy that predicts at every step.

    ``adaptive`` weights an action by exp(coefficient * its cosine with the newest one), so a chunk that
    disagrees counts less (CogACT, arXiv 2411.19650). ``newest_only``: dimensions that are not averaged,
    such as a gripper that is open or closed.
    """

    def __init__(self, size: int, weighting: str, coefficient: float, newest_only: Sequence[int] = ()):
        self._weighting, self._coefficient = weighting, coefficient
        self._newest_only = list(newest_only)
        self._chunks: deque[Tensor] = deque(maxlen=size)

    def reset(self) -> None:
        """Forget all chunks, for a new episode."""
        self._chunks.clear()

    def __call__(self, chunk_BTD: Tensor) -> Tensor:
        """(B, T, D) newest chunk, T at least the ensemble's size -> (B, D) action of this step."""
        self._chunks.appendleft(chunk_BTD)
        actions_BID = torch.stack([chunk[:, age] for age, chunk in enumerate(self._chunks)], dim=1)
        weights_BI1 = self._weights(actions_BID)[..., None]
        action_BD = (weights_BI1 * actions_BID).sum(dim=1) / weights_BI1.sum(dim=1)
        action_BD[:, self._newest_only] = actions_BID[:, 0, self._newest_only]
        return action_BD

    def _weights(self, actions_BID: Tensor) -> Tensor:
        """(B, I) weights; (1, I) if they are the same for all rows."""
        if self._weighting == "adaptive":
            return torch.exp(self._coefficient * cosine_similarity(actions_BID, actions_BID[:, :1], dim=2))
        weights_I = age_weights(self._weighting, actions_BID.shape[1], self._coefficient)
        return weights_I[None].to(actions_BID)
