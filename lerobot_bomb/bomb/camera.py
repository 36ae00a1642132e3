"""Projection of points of the world into a camera's image."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class PinholeCamera:
    """Intrinsics and pose of the camera that took an image."""

    intrinsics: np.ndarray  # (3, 3) pixels; the centre of the top left pixel is (0, 0)
    world_from_camera: np.ndarray  # (4, 4) metres; camera axes x right, y down, z forward

    def pixel_of(self, xyz: np.ndarray) -> np.ndarray:
        """(2,) pixels, right and down, of a point (3,) in metres that lies in front of the camera."""
        camera_from_world = np.linalg.inv(self.world_from_camera.astype(np.float64))
        x, y, depth = self.intrinsics @ (camera_from_world @ [*xyz, 1.0])[:3]
        return np.array([x / depth, y / depth])
