# pyright: reportAttributeAccessIssue=false
"""Rotations as MuJoCo computes them."""

import numpy as np

from lerobot_env_bomb.shared.mujoco_gl import mujoco


def rotation(axis: np.ndarray, angle_rad: float) -> np.ndarray:
    """(3, 3) rotation around a unit axis."""
    quat, matrix = np.empty(4), np.empty(9)
    mujoco.mju_axisAngle2Quat(quat, axis, angle_rad)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def matrix_of(quat: np.ndarray) -> np.ndarray:
    """(3, 3) rotation of a quaternion."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def quaternion_of(matrix: np.ndarray) -> np.ndarray:
    """(4,) w, x, y, z of a (3, 3) rotation, or of its nine numbers."""
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(matrix).ravel())
    return quat
