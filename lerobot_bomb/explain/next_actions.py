"""Next executed actions of a policy, in millimetres, when something that it reads is changed.

Every query starts from the same random state, so nothing else makes them differ.
"""

import numpy as np
import torch

from lerobot_bomb.bomb.observation import reach_m
from lerobot_bomb.explain.scored_policy import Batch, ScoredPolicy
from lerobot_bomb.viewing.checkpoint import LoadedPolicy


class NextActions:
    """Actions that a policy executes before it looks again, from one observation of BOMB."""

    def __init__(
        self, loaded: LoadedPolicy, scored: ScoredPolicy, observation: Batch, control_mode: str
    ) -> None:
        self._loaded, self._scored = loaded, scored
        self._observation, self._control_mode = observation, control_mode
        self.clean_m = self.reached_m({})

    def reached_m(self, changes: Batch, hidden_S: torch.Tensor | None = None) -> np.ndarray:
        """(3,) metres where the actions lead, from where the gripper is or in the world's frame.

        ``changes``: values of the observation that are replaced; ``hidden_S``: tokens of the instruction.
        """
        loaded = self._loaded
        loaded.begin()
        prepared = loaded.prepare({**self._observation, **changes})
        if hidden_S is not None:
            prepared = self._scored.hide_in(prepared, hidden_S)
        num_steps = getattr(loaded.config, "n_action_steps", 1)
        actions = np.concatenate([loaded.act(prepared) for _ in range(num_steps)])
        return reach_m(actions, self._control_mode)

    def moved_mm(self, changes: Batch, hidden_S: torch.Tensor | None = None) -> float:
        """Distance from where the actions lead to where the changed ones lead."""
        return 1e3 * float(np.linalg.norm(self.reached_m(changes, hidden_S) - self.clean_m))
