# pyright: reportAttributeAccessIssue=false
"""Perturbation axis `camera`: pose and field of view of the cameras."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from lerobot_bomb.libero.perturbations import libero_magnitude
from lerobot_env_bomb_libero.scene import CAMERAS, LiberoScene, LiberoTransform
from lerobot_env_bomb_libero.stock import mujoco
from lerobot_env_mujoco.rotations import matrix_of, rotation

FRAME_MARGIN = 0.02  # of half the image, that what must stay in view keeps from its edge
GRIPPER_M = 0.1  # before the wrist's camera, what it turns around
MAX_RETREAT = 1.6  # times the nominal distance


@dataclass(frozen=True)
class LiberoCamera(LiberoTransform):
    """Pose and field of view of both cameras; what the scene's camera showed of objects it still shows."""

    angle_rad: float
    wrist_angle_rad: float
    direction_rad: float  # in the image, that the cameras swing to
    fov_factor: float
    distance_factor: float

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Any) -> Self:
        signs = rng.choice((-1.0, 1.0), 2)
        return cls(
            angle_rad=float(np.radians(libero_magnitude("camera", "angle", level))),
            wrist_angle_rad=float(np.radians(libero_magnitude("camera", "wrist_angle", level))),
            direction_rad=float(rng.uniform(-np.pi, np.pi)),
            fov_factor=1 + float(signs[0]) * libero_magnitude("camera", "fov", level),
            distance_factor=1 + float(signs[1]) * libero_magnitude("camera", "distance", level),
        )

    def arrange(self, scene: LiberoScene) -> None:
        # objects stand where the episode starts, so it is known what was in view
        model, data = scene.model, scene.data
        mujoco.mj_forward(model, data)
        view, wrist = (model.camera(name).id for name in CAMERAS)
        pose, position = matrix_of(model.cam_quat[view]), model.cam_pos[view].copy()
        needed = scene.corners()
        needed = needed[_is_in_view(needed - position, pose, model.cam_fovy[view])]
        pivot = _looked_at(position, pose, needed)
        for camera in (view, wrist):
            model.cam_fovy[camera] *= self.fov_factor
        self._swing(scene, wrist, model.cam_pos[wrist] - GRIPPER_M * matrix_of(model.cam_quat[wrist])[:, 2],
                    self.wrist_angle_rad)  # fmt: skip
        self._swing(scene, view, pivot, self.angle_rad)
        pose = matrix_of(model.cam_quat[view])
        nominal_m = float(np.linalg.norm(position - pivot))
        least_m = _least_distance(needed - pivot, pose, model.cam_fovy[view])
        distance_m = min(max(nominal_m * self.distance_factor, least_m), nominal_m * MAX_RETREAT)
        model.cam_pos[view] = pivot + distance_m * pose[:, 2]

    def _swing(self, scene: LiberoScene, camera: int, pivot: np.ndarray, angle_rad: float) -> None:
        """Turn a camera's pose around a point of its body's frame."""
        model = scene.model
        pose = matrix_of(model.cam_quat[camera])
        axis = np.cos(self.direction_rad) * pose[:, 0] + np.sin(self.direction_rad) * pose[:, 1]
        turn = rotation(axis, angle_rad)
        model.cam_pos[camera] = pivot + turn @ (model.cam_pos[camera] - pivot)
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, (turn @ pose).ravel())
        model.cam_quat[camera] = quat


def _looked_at(position: np.ndarray, pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(3,) the point on the line of sight that is as far away as the points are on average."""
    depth_m = float(np.mean((position - points) @ pose[:, 2])) if len(points) else 1.0
    return position - depth_m * pose[:, 2]


def _is_in_view(offsets: np.ndarray, pose: np.ndarray, fovy_deg: float) -> np.ndarray:
    """(n, 3) from a camera -> (n,) whether its square image shows them."""
    right, up, backward = offsets @ pose[:, 0], offsets @ pose[:, 1], offsets @ pose[:, 2]
    return np.maximum(abs(right), abs(up)) <= -backward * np.tan(np.radians(fovy_deg) / 2)


def _least_distance(offsets: np.ndarray, pose: np.ndarray, fovy_deg: float) -> float:
    """Metres from the pivot, (n, 3) offsets from it, at which a square image shows them all."""
    if not len(offsets):
        return 0.0
    right, up, backward = offsets @ pose[:, 0], offsets @ pose[:, 1], offsets @ pose[:, 2]
    slope = np.tan(np.radians(fovy_deg) / 2) * (1 - FRAME_MARGIN)
    return float(np.max(backward + np.maximum(abs(right), abs(up)) / slope))
