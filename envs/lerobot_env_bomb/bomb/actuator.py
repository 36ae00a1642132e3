"""Actuator: a policy's action becomes the arm's command, by control mode, latency and noise."""

from collections import deque

import numpy as np

from lerobot_bomb.bomb import so101
from lerobot_bomb.bomb.observation import MAX_STEP_DEG, MAX_STEP_M
from lerobot_bomb.bomb.streams import Stream, generator
from lerobot_env_bomb.bomb.axes.dynamics import Dynamics


class Actuator:
    """Actuator of one episode; `dynamics` makes it late and imprecise."""

    def __init__(
        self,
        control_mode: str,
        gripper_xyz: np.ndarray,
        stone_radius_m: float,
        dynamics: Dynamics | None,
        seed: int,
    ):
        self._control_mode, self._stone_radius_m = control_mode, stone_radius_m
        step = MAX_STEP_DEG if control_mode == "joints" else MAX_STEP_M
        self._noise = 0.0 if dynamics is None else step * dynamics.noise
        self._rng = generator(seed, Stream.ACTUATOR_NOISE)
        # until the first action arrives: stay, with open fingers
        if control_mode == "joints":
            rest = so101.to_driver(so101.joints_at(gripper_xyz, so101.MAX_HALF_OPENING_M))
        else:
            rest = np.array([*(gripper_xyz if control_mode == "absolute" else np.zeros(3)), 1.0])
        self._pending = deque([rest] * (0 if dynamics is None else dynamics.latency))

    def command(self, action: np.ndarray, gripper_xyz: np.ndarray) -> np.ndarray:
        """(D,) action -> (D,) command of now: position in metres and gripper's command, or joints."""
        self._pending.append(action)
        command = self._pending.popleft().copy()
        if self._control_mode == "relative":
            command[:3] = gripper_xyz + MAX_STEP_M * command[:3]
        if self._noise > 0:
            command[:-1] += self._noise * self._rng.standard_normal(len(command) - 1)
        return command

    def pending_motion_m(self, gripper_xyz: np.ndarray, finger_opening_m: float) -> np.ndarray:
        """(3,) metres that actions still to be executed will move the gripper."""
        if not self._pending:
            return np.zeros(3)
        if self._control_mode == "joints":
            joints = so101.from_driver(self._pending[-1])
            stone_m = self._stone_radius_m if self.pending_gripper < 0 else 0.0
            expected_m = so101.expected_half_opening_m(joints[-1], finger_opening_m / 2, stone_m)
            return so101.grip_pose(joints, expected_m)[0] - gripper_xyz
        if self._control_mode == "absolute":
            return self._pending[-1][:3] - gripper_xyz
        return MAX_STEP_M * np.sum([action[:3] for action in self._pending], axis=0)

    @property
    def pending_gripper(self) -> float:
        """The last gripper command that is still to be executed, or 0."""
        if not self._pending:
            return 0.0
        if self._control_mode == "joints":
            jaw = so101.from_driver(self._pending[-1])[-1]
            return 1.0 if so101.jaw_half_opening_m(jaw) > self._stone_radius_m else -1.0
        return float(self._pending[-1][3])
