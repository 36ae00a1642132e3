"""Base of policies whose actions are tokens."""

from typing import Any

from lerobot.datasets import LeRobotDatasetMetadata
from torch import Tensor

from lerobot_bomb.flow.noise import SamplingNoise, gumbel
from lerobot_bomb.policies.config import TokenVlaConfig
from lerobot_bomb.policies.policy import VlaPolicy


class TokenVlaPolicy(VlaPolicy):
    """Policy whose actions are tokens; it writes only those that are executed."""

    config_class = TokenVlaConfig  # pyright: ignore[reportAssignmentType]
    name = "token_vla"  # pyright: ignore[reportAssignmentType]
    config: TokenVlaConfig
    _sampling_noise: SamplingNoise

    def __init__(self, config: Any, dataset_meta: LeRobotDatasetMetadata | None = None, **_: object):
        super().__init__(config, dataset_meta)
        self._sampling_noise = SamplingNoise(config.noise_seed, is_per_episode=True, draw=gumbel)

    def predict_action_chunk(
        self,
        batch: dict[str, Tensor],
        *,
        inference_delay: int | None = None,
        prev_chunk_left_over: Tensor | None = None,
    ) -> Tensor:
        """(B, T, D) normalised actions.

        The other arguments come from LeRobot's real-time chunking; they do not guide a chunk of tokens.
        """
        return super().predict_action_chunk(batch)

    def _choice_noise(self, batch_size: int, shape: tuple[int, ...]) -> Tensor | None:
        """Return noise (B, *shape) that makes the argmax of logits a sample; None for a greedy choice."""
        if not self.config.temperature:
            return None
        noise = self._sampling_noise.draw(batch_size, shape)
        return self.config.temperature * noise.to(self._device)
