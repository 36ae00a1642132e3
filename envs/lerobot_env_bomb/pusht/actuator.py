"""Actuator: a policy's action becomes the place where the agent is sent, by latency and noise."""

from collections import deque

import numpy as np

from lerobot_bomb.bomb.streams import Stream, generator
from lerobot_env_bomb.pusht.axes.dynamics import PushTDynamics


class PushTActuator:
    """Actuator of one episode under `dynamics`; until the first action arrives the agent stays."""

    def __init__(self, agent_xy: np.ndarray, dynamics: PushTDynamics, seed: int):
        self._noise_px = dynamics.noise_px
        self._rng = generator(seed, Stream.ACTUATOR_NOISE)
        self._pending = deque([agent_xy] * dynamics.latency)

    def command(self, action: np.ndarray) -> np.ndarray:
        """(2,) action -> (2,) pixels where the agent is sent now."""
        self._pending.append(action)
        return self._pending.popleft() + self._noise_px * self._rng.standard_normal(2)
