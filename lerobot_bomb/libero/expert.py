"""The scripted expert's action: a step towards the pose that its plan names."""

from dataclasses import dataclass, field
from typing import Self

import numpy as np

OPEN, CLOSE = -1.0, 1.0  # commands of the gripper
MAX_MOTION_M, MAX_TURN_RAD = 0.05, 0.5  # that an action of 1 asks for
GAIN = 1.4  # share of what is left that an action asks for; the arm follows softly
PENDING = 0.35  # share of a command that the arm carries out in a step


@dataclass(frozen=True)
class LiberoState:
    """State that the expert reads: the simulator's, and the next pose of its plan."""

    gripper_xyz: np.ndarray  # (3,) metres
    gripper_mat: np.ndarray  # (3, 3) rotation
    target_xyz: np.ndarray  # (3,) metres
    target_mat: np.ndarray  # (3, 3) rotation
    gripper: float  # command of the gripper
    speed: float = 1.0  # share of the highest
    # commands that latency holds back: motion in metres, rotation vector in radians
    pending_m: np.ndarray = field(default_factory=lambda: np.zeros(3))
    pending_rad: np.ndarray = field(default_factory=lambda: np.zeros(3))

    DIM = 32

    def to_vector(self) -> np.ndarray:
        """(32,) float32, the observation `environment_state`."""
        parts = (
            self.gripper_xyz, self.gripper_mat.ravel(), self.target_xyz, self.target_mat.ravel(),
            [self.gripper, self.speed], self.pending_m, self.pending_rad,
        )  # fmt: skip
        return np.concatenate(parts).astype(np.float32)

    @classmethod
    def from_vector(cls, vector: np.ndarray) -> Self:
        """Inverse of `to_vector`, in float64.

        Raises:
            ValueError: the vector has another length.
        """
        vector = np.asarray(vector, dtype=np.float64)
        if vector.shape != (cls.DIM,):
            raise ValueError(f"environment_state has shape {vector.shape}, expected ({cls.DIM},)")
        xyz, mat, target_xyz, target_mat, (gripper, speed), pending_m, pending_rad = np.split(
            vector, np.cumsum([3, 9, 3, 9, 2, 3])
        )
        return cls(
            xyz,
            mat.reshape(3, 3),
            target_xyz,
            target_mat.reshape(3, 3),
            gripper,
            speed,
            pending_m,
            pending_rad,
        )


def libero_expert_action(state: LiberoState) -> np.ndarray:
    """(7,) float32 relative action that brings the gripper to its target, within [-1, 1]."""
    motion_m = state.target_xyz - state.gripper_xyz - PENDING * state.pending_m
    turn_rad = rotation_vector(state.target_mat @ state.gripper_mat.T) - PENDING * state.pending_rad
    motion = _limited(GAIN * motion_m / MAX_MOTION_M, state.speed)
    turn = _limited(GAIN * turn_rad / MAX_TURN_RAD, state.speed)
    return np.array([*motion, *turn, state.gripper], dtype=np.float32)


def _limited(vector: np.ndarray, most: float) -> np.ndarray:
    """Shorten a vector to a length, so that it keeps its direction."""
    return vector * min(1.0, most / max(float(np.linalg.norm(vector)), 1e-9))


def angle_of(mat: np.ndarray) -> float:
    """Return the angle in radians of a (3, 3) rotation."""
    return float(np.arccos(np.clip((np.trace(mat) - 1) / 2, -1, 1)))


def rotation_vector(mat: np.ndarray) -> np.ndarray:
    """(3, 3) rotation -> (3,) axis times angle in radians."""
    angle_rad = angle_of(mat)
    if angle_rad < 1e-6:
        return np.zeros(3)
    if angle_rad > np.pi - 1e-3:  # the sine vanishes: the axis is a column of the symmetric part
        column = int(np.argmax(np.diag(mat)))
        axis = (mat + np.eye(3))[:, column]
        return angle_rad * axis / np.linalg.norm(axis)
    axis = np.array([mat[2, 1] - mat[1, 2], mat[0, 2] - mat[2, 0], mat[1, 0] - mat[0, 1]])
    return angle_rad * axis / (2 * np.sin(angle_rad))
