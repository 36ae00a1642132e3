"""``bomb_random``: the floor of the benchmark."""

import numpy as np
import torch
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_bomb.schema import action_bounds
from lerobot_bomb.scripted import ScriptedPolicy
from lerobot_policy_bomb_random.configuration_bomb_random import BombRandomConfig


class BombRandomPolicy(ScriptedPolicy):
    """Draws every action uniformly from the action space."""

    config_class = BombRandomConfig
    name = "bomb_random"
    config: BombRandomConfig

    def select_action(self, batch: dict[str, Tensor], **_: object) -> Tensor:
        """Observation ``state`` (B, S) -> (B, D) actions in env units.

        A row's generator is seeded with its step and state, so the actions differ between episodes and
        do not depend on the other rows of the batch.
        """
        low, high = action_bounds(self.config.control_mode)
        states = batch[OBS_STATE].cpu().numpy().astype(np.float32)
        entropies = [[self.config.seed, self._step, *bits] for bits in states.view(np.uint32).tolist()]
        actions = [np.random.default_rng(entropy).uniform(low, high) for entropy in entropies]
        self._step += 1
        return torch.from_numpy(np.stack(actions).astype(np.float32))

    def reset(self) -> None:
        """Start a new episode: count steps from zero."""
        self._step = 0
