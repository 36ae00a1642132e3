# pyright: reportAttributeAccessIssue=false
"""Perturbation axis `camera`: pose and field of view of the cameras."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from lerobot_bomb.bomb.board import BOARD, TRAY_CENTER_XY, TRAY_HALF_SIZE_XY
from lerobot_bomb.bomb.observation import CAMERAS
from lerobot_bomb.bomb.perturbations import magnitude
from lerobot_bomb.bomb.suite import Episode
from lerobot_env_bomb.axes.transform import Transform
from lerobot_env_bomb.model import BOARD_HALF_SIZE_M
from lerobot_env_mujoco.mujoco_gl import mujoco
from lerobot_env_mujoco.rotations import matrix_of, rotation

FRAME_MARGIN = 0.015  # of half the image, that what must stay in view keeps from its edge
START_HEIGHT_M = 0.115  # of the gripper over the tray, which must be in view too


@dataclass(frozen=True)
class Camera(Transform):
    """Pose and field of view of both cameras; the workspace camera keeps board and tray in view."""

    angle_rad: float
    wrist_angle_rad: float
    direction_rad: float  # in the image, that the cameras swing to
    fov_factor: float
    distance_factor: float

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Episode) -> Self:
        signs = rng.choice((-1.0, 1.0), 2)
        return cls(
            angle_rad=float(np.radians(magnitude("camera", "angle", level))),
            wrist_angle_rad=float(np.radians(magnitude("camera", "wrist_angle", level))),
            direction_rad=float(rng.uniform(-np.pi, np.pi)),
            fov_factor=1 + float(signs[0]) * magnitude("camera", "fov", level),
            distance_factor=1 + float(signs[1]) * magnitude("camera", "distance", level),
        )

    def edit_model(self, model: mujoco.MjModel) -> None:
        workspace, wrist = (model.camera(name) for name in CAMERAS)
        for camera in (workspace, wrist):
            camera.fovy *= self.fov_factor
        self._swing(wrist, model.site("grip").pos, self.wrist_angle_rad)  # of the same body
        backward = matrix_of(workspace.quat)[:, 2]
        pivot = workspace.pos - backward * workspace.pos[2] / backward[2]  # where it looks on the table
        distance_m = np.linalg.norm(workspace.pos - pivot) * self.distance_factor
        self._swing(workspace, pivot, self.angle_rad)
        camera_from_world = matrix_of(workspace.quat).T
        distance_m = max(distance_m, _least_distance(camera_from_world, pivot, workspace.fovy[0]))
        workspace.pos[:] = pivot + distance_m * camera_from_world[2]

    def _swing(self, camera: Any, pivot: np.ndarray, angle_rad: float) -> None:
        """Turn a named camera's pose around a point of its body's frame."""
        matrix = matrix_of(camera.quat)
        axis = np.cos(self.direction_rad) * matrix[:, 0] + np.sin(self.direction_rad) * matrix[:, 1]
        turn = rotation(axis, angle_rad)
        camera.pos[:] = pivot + turn @ (camera.pos - pivot)
        mujoco.mju_mat2Quat(camera.quat, (turn @ matrix).ravel())


def _least_distance(camera_from_world: np.ndarray, pivot: np.ndarray, fovy_deg: float) -> float:
    """Metres from the pivot at which a square image shows board, tray and the gripper over the tray."""
    signs = np.array([(x, y) for x in (-1, 1) for y in (-1, 1)])
    board = _at_height(signs * BOARD_HALF_SIZE_M, BOARD.thickness_m)
    tray = _at_height(TRAY_CENTER_XY + signs * TRAY_HALF_SIZE_XY, BOARD.thickness_m)
    gripper = _at_height(TRAY_CENTER_XY + signs * TRAY_HALF_SIZE_XY[0], START_HEIGHT_M)
    right, up, backward = camera_from_world @ (np.concatenate([board, tray, gripper]) - pivot).T
    slope = np.tan(np.radians(fovy_deg) / 2) * (1 - FRAME_MARGIN)
    return float(np.max(backward + np.maximum(abs(right), abs(up)) / slope))


def _at_height(xy: np.ndarray, height_m: float) -> np.ndarray:
    """(n, 2) -> (n, 3) metres."""
    return np.column_stack([xy, np.full(len(xy), height_m)])
