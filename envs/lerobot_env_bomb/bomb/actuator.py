"""Actuator: a policy's action becomes the gripper's command, by control mode, latency and noise."""

from collections import deque

import numpy as np

from lerobot_bomb.bomb.observation import MAX_STEP_M
from lerobot_bomb.bomb.streams import Stream, generator
from lerobot_env_bomb.bomb.axes.dynamics import Dynamics


class Actuator:
    """Actuator of one episode; `dynamics` makes it late and imprecise."""

    def __init__(self, control_mode: str, gripper_xyz: np.ndarray, dynamics: Dynamics | None, seed: int):
        self._is_absolute = control_mode == "absolute"
        self._noise_m = 0.0 if dynamics is None else MAX_STEP_M * dynamics.noise
        self._rng = generator(seed, Stream.ACTUATOR_NOISE)
        # until the first action arrives: stay, with open fingers
        rest = np.array([*(gripper_xyz if self._is_absolute else np.zeros(3)), 1.0])
        self._pending = deque([rest] * (0 if dynamics is None else dynamics.latency))

    def command(self, action: np.ndarray, gripper_xyz: np.ndarray) -> tuple[np.ndarray, bool]:
        """(4,) action -> (3,) position in metres to go to now, and True to open the fingers."""
        self._pending.append(action)
        executed = self._pending.popleft()
        target_xyz = executed[:3] if self._is_absolute else gripper_xyz + MAX_STEP_M * executed[:3]
        if self._noise_m > 0:
            target_xyz = target_xyz + self._noise_m * self._rng.standard_normal(3)
        return target_xyz, bool(executed[3] >= 0)

    def pending_motion_m(self, gripper_xyz: np.ndarray) -> np.ndarray:
        """(3,) metres that actions still to be executed will move the gripper."""
        if not self._pending:
            return np.zeros(3)
        if self._is_absolute:
            return self._pending[-1][:3] - gripper_xyz
        return MAX_STEP_M * np.sum([action[:3] for action in self._pending], axis=0)

    @property
    def pending_gripper(self) -> float:
        """The last gripper command that is still to be executed, or 0."""
        return float(self._pending[-1][3]) if self._pending else 0.0
