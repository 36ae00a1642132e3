"""Actuator: a policy's action becomes the arm's, by latency and noise."""

from collections import deque

import numpy as np

from lerobot_bomb.bomb.streams import Stream, generator
from lerobot_bomb.libero.episode import MOTION_DIMS
from lerobot_env_bomb.libero.axes.dynamics import LiberoDynamics
from lerobot_env_bomb.libero.stock import get_libero_dummy_action


class LiberoActuator:
    """Actuator of one episode under `dynamics`; until the first action arrives, the arm holds still."""

    def __init__(self, dynamics: LiberoDynamics, seed: int):
        self._noise = dynamics.noise
        self._rng = generator(seed, Stream.ACTUATOR_NOISE)
        self._pending = deque([np.array(get_libero_dummy_action(), np.float32)] * dynamics.latency)

    @property
    def pending(self) -> np.ndarray:
        """(6,) sum of the motions that latency holds back."""
        return np.sum([np.zeros(MOTION_DIMS), *(each[:MOTION_DIMS] for each in self._pending)], axis=0)

    def command(self, action: np.ndarray) -> np.ndarray:
        """(7,) action -> (7,) command to the arm."""
        self._pending.append(action)
        command = self._pending.popleft().astype(np.float32)
        noise = self._noise * self._rng.standard_normal(MOTION_DIMS)
        command[:MOTION_DIMS] = np.clip(command[:MOTION_DIMS] + noise, -1, 1)
        return command
