# pyright: reportAttributeAccessIssue=false
"""Perturbation axis `camera`: pose and field of view of the cameras."""

import numpy as np

from lerobot_bomb.bomb.board import BOARD, TRAY_CENTER_XY, TRAY_HALF_SIZE_XY
from lerobot_bomb.bomb.observation import CAMERAS
from lerobot_bomb.bomb.perturbations import AXES
from lerobot_env_bomb.bomb.axes.transform import Transform
from lerobot_env_bomb.shared.mujoco_gl import mujoco
from lerobot_env_bomb.shared.rotations import matrix_of
from lerobot_env_bomb.shared.transforms import CameraTransform, least_distance

FRAME_MARGIN = 0.015  # share of half the image, from its edge to what must stay in view
START_HEIGHT_M = 0.115  # of the gripper over the tray, which must be in view too


class Camera(CameraTransform, Transform):
    """Pose and field of view of both cameras; the workspace camera keeps board and tray in view."""

    axes = AXES

    def edit_model(self, model: mujoco.MjModel) -> None:
        workspace, wrist = (model.camera(name) for name in CAMERAS)
        for camera in (workspace, wrist):
            camera.fovy *= self.fov_factor
        self.swing(wrist, model.site("grip").pos, self.wrist_angle_rad)  # of the same body
        backward = matrix_of(workspace.quat)[:, 2]
        pivot = workspace.pos - backward * workspace.pos[2] / backward[2]  # where it looks on the table
        distance_m = np.linalg.norm(workspace.pos - pivot) * self.distance_factor
        self.swing(workspace, pivot, self.angle_rad)
        camera_from_world = matrix_of(workspace.quat).T
        distance_m = max(distance_m, _least_distance(camera_from_world, pivot, workspace.fovy[0]))
        workspace.pos[:] = pivot + distance_m * camera_from_world[2]


def _least_distance(camera_from_world: np.ndarray, pivot: np.ndarray, fovy_deg: float) -> float:
    """Metres from the pivot from which a square image shows board, tray and the gripper over the tray."""
    signs = np.array([(x, y) for x in (-1, 1) for y in (-1, 1)])
    board = _at_height(signs * BOARD.half_size_m, BOARD.thickness_m)
    tray = _at_height(TRAY_CENTER_XY + signs * TRAY_HALF_SIZE_XY, BOARD.thickness_m)
    gripper = _at_height(TRAY_CENTER_XY + signs * TRAY_HALF_SIZE_XY[0], START_HEIGHT_M)
    offsets = np.concatenate([board, tray, gripper]) - pivot
    return least_distance(offsets, camera_from_world, fovy_deg, FRAME_MARGIN)


def _at_height(xy: np.ndarray, height_m: float) -> np.ndarray:
    """(n, 2) -> (n, 3) metres."""
    return np.column_stack([xy, np.full(len(xy), height_m)])
