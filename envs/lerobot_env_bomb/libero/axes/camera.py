# pyright: reportAttributeAccessIssue=false
"""Perturbation axis `camera`: pose and field of view of the cameras."""

import numpy as np

from lerobot_bomb.libero.perturbations import LIBERO_AXES
from lerobot_env_bomb.libero.scene import CAMERAS, LiberoScene, LiberoTransform
from lerobot_env_bomb.libero.stock import mujoco
from lerobot_env_bomb.shared.rotations import matrix_of
from lerobot_env_bomb.shared.transforms import CameraTransform, least_distance

FRAME_MARGIN = 0.02  # share of half the image, from its edge to what must stay in view
GRIPPER_M = 0.1  # from the wrist's camera to the point that it turns around
MAX_RETREAT = 1.6  # times the nominal distance


class LiberoCamera(CameraTransform, LiberoTransform):
    """Pose and field of view of both cameras; objects in the scene camera's view stay in view."""

    axes = LIBERO_AXES

    def arrange(self, scene: LiberoScene) -> None:
        # objects stand where the episode starts, so it is known what was in view
        model = scene.model
        mujoco.mj_forward(model, scene.data)
        view, wrist = (model.camera(name) for name in CAMERAS)
        pose, position = matrix_of(view.quat), view.pos.copy()
        needed = scene.corners()
        needed = needed[_is_in_view(needed - position, pose, view.fovy[0])]
        pivot = _looked_at(position, pose, needed)
        for camera in (view, wrist):
            camera.fovy *= self.fov_factor
        self.swing(wrist, wrist.pos - GRIPPER_M * matrix_of(wrist.quat)[:, 2], self.wrist_angle_rad)
        self.swing(view, pivot, self.angle_rad)
        camera_from_world = matrix_of(view.quat).T
        nominal_m = float(np.linalg.norm(position - pivot))
        distance_m = nominal_m * self.distance_factor
        if len(needed):
            least_m = least_distance(needed - pivot, camera_from_world, view.fovy[0], FRAME_MARGIN)
            distance_m = max(distance_m, least_m)
        view.pos[:] = pivot + min(distance_m, nominal_m * MAX_RETREAT) * camera_from_world[2]


def _looked_at(position: np.ndarray, pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(3,) the point on the line of sight that is as far away as the points are on average."""
    depth_m = float(np.mean((position - points) @ pose[:, 2])) if len(points) else 1.0
    return position - depth_m * pose[:, 2]


def _is_in_view(offsets: np.ndarray, pose: np.ndarray, fovy_deg: float) -> np.ndarray:
    """Offsets (n, 3) from a camera -> (n,) bool: its square image shows the point."""
    right, up, backward = offsets @ pose[:, 0], offsets @ pose[:, 1], offsets @ pose[:, 2]
    return np.maximum(abs(right), abs(up)) <= -backward * np.tan(np.radians(fovy_deg) / 2)
