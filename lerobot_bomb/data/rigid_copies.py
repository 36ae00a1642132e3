"""Demonstrations on a plane, copied: turned, mirrored and shifted, the goal with the rest.

Pushing does not depend on where north is, so a copy is as good a demonstration as what it is made from, for a
policy that sees the goal (as in Zeng et al., Transporter Networks, arXiv 2010.14406, section 4).
"""

from dataclasses import dataclass

import cv2
import numpy as np

MAX_SHIFT = 40.0  # of the board's centre along x and y; its unit is that of positions
BACKGROUND = (255, 255, 255)  # of what lies outside of the image that is copied


@dataclass(frozen=True)
class RigidMotion:
    """Takes the point x of the plane to `linear @ x + offset`; `linear` (2, 2) is orthogonal."""

    linear: np.ndarray
    offset: np.ndarray

    @classmethod
    def drawn(cls, generator: np.random.Generator, board_size: float) -> "RigidMotion":
        """Any angle, mirrored or not, and a shift of the board's centre by MAX_SHIFT at most."""
        angle_rad = generator.uniform(-np.pi, np.pi)
        mirror = generator.choice([-1, 1])
        shift = generator.uniform(-MAX_SHIFT, MAX_SHIFT, 2)
        sin, cos = np.sin(angle_rad), np.cos(angle_rad)
        linear = np.array([[cos, -sin * mirror], [sin, cos * mirror]])
        centre = np.full(2, board_size / 2)
        return cls(linear, centre + shift - linear @ centre)

    def points(self, positions: np.ndarray) -> np.ndarray:
        """Positions (T, 2), moved; float32."""
        return (positions @ self.linear.T + self.offset).astype(np.float32)

    def images(self, images: np.ndarray, board_size: float) -> np.ndarray:
        """Square images (T, S, S, 3) uint8 of the whole board, moved."""
        pixels = images.shape[1] / board_size
        half = np.full(2, 0.5)  # the middle of the first pixel is half a pixel from the board's edge
        offset = self.linear @ half + pixels * self.offset - half
        matrix = np.concatenate([self.linear, offset[:, None]], axis=1)
        size = images.shape[1:3]
        options = {"flags": cv2.INTER_CUBIC, "borderMode": cv2.BORDER_CONSTANT, "borderValue": BACKGROUND}
        return np.stack([cv2.warpAffine(image, matrix, size, **options) for image in images])
