"""Copies of demonstrations on a plane: rotated, mirrored and shifted, together with the goal.

Pushing does not depend on where north is, so a copy is as good as its original for a policy that sees the
goal (as in Zeng et al., Transporter Networks, arXiv 2010.14406).
"""

from dataclasses import dataclass

import cv2
import numpy as np

MAX_SHIFT = 40.0  # of the board's centre along x and y; its unit is that of positions
BACKGROUND = (255, 255, 255)  # of what lies outside of the image that is copied
MIRROR = np.array([[0.0, -1.0], [-1.0, 0.0]])  # across a diagonal


@dataclass(frozen=True)
class RigidMotion:
    """Motion of a point x of a square board of `board_size` to `centre + shift + linear @ (x - centre)`."""

    board_size: float
    linear: np.ndarray  # (2, 2), orthogonal
    shift: np.ndarray  # (2,)

    @classmethod
    def drawn(cls, generator: np.random.Generator, board_size: float) -> "RigidMotion":
        """Draw any angle, mirrored or not, and a shift by MAX_SHIFT at most along x and along y."""
        angle_rad = np.radians(generator.uniform(-180, 180))
        is_mirrored = generator.random() < 0.5
        shift = generator.uniform(-MAX_SHIFT, MAX_SHIFT, 2)
        sin, cos = np.sin(angle_rad), np.cos(angle_rad)
        linear = np.array([[cos, -sin], [sin, cos]])
        return cls(board_size, linear @ MIRROR if is_mirrored else linear, shift)

    def points(self, positions: np.ndarray) -> np.ndarray:
        """Move positions (T, 2); float32."""
        moved = (positions - self._centre) @ self.linear.T + self._centre + self.shift
        return moved.astype(np.float32)

    def images(self, images: np.ndarray) -> np.ndarray:
        """Move square images (T, S, S, 3) uint8 of the whole board."""
        pixels = images.shape[1] / self.board_size
        half = np.full(2, 0.5)  # the middle of the first pixel is half a pixel from the board's edge
        offset = (self._centre + self.shift - self.linear @ self._centre) * pixels + self.linear @ half - half
        matrix = np.concatenate([self.linear, offset[:, None]], axis=1)
        size = images.shape[1:3]
        options = {"flags": cv2.INTER_CUBIC, "borderMode": cv2.BORDER_CONSTANT, "borderValue": BACKGROUND}
        return np.stack([cv2.warpAffine(image, matrix, size, **options) for image in images])

    @property
    def _centre(self) -> np.ndarray:
        return np.full(2, self.board_size / 2)
