"""Pinhole cameras, and how they follow an image that is cropped and resized. All in float32.

Shapes: `B` batch, `R` side of a square image, pixels.
K (B, 3, 3) has focal lengths and principal point in pixels *counted from the image's edge*: the centre of
the top left pixel is (0.5, 0.5). So resizing only scales K, as it does in SpatialVLA.
"""

import torch
from torch import Tensor

from lerobot_bomb.vlm.images import CropWindows

# What SpatialVLA assumes of every camera: focal length and principal point, pixels of an image of this size
DEFAULT_FOCAL_PX, DEFAULT_CENTER_PX = 623.588, (319.501, 239.545)
DEFAULT_HEIGHT_PX, DEFAULT_WIDTH_PX = 480, 640


def default_intrinsics(height: int, width: int) -> Tensor:
    """Return K (1, 3, 3) of an unknown camera whose images are stretched to height x width."""
    center_x, center_y = DEFAULT_CENTER_PX
    K = torch.tensor([[[DEFAULT_FOCAL_PX, 0, center_x], [0, DEFAULT_FOCAL_PX, center_y], [0, 0, 1]]])
    return resize_intrinsics(K, (DEFAULT_HEIGHT_PX, DEFAULT_WIDTH_PX), (height, width))


def from_pixel_centers(K_B33: Tensor, name: str) -> Tensor:
    """K as calibrations and `bomb/observation.py` have it, (0, 0) the centre of the top left pixel -> ours.

    Raises:
        ValueError: K is not a pinhole camera's; the message calls it ``name``.
    """
    K_B33 = K_B33.float()
    is_shaped = K_B33.ndim == 3 and K_B33.shape[1:] == (3, 3)
    if not is_shaped or not K_B33.isfinite().all():
        found = "numbers that are not finite" if is_shaped else f"shape {tuple(K_B33.shape)}"
        raise ValueError(f"{name} has {found}; give the camera's 3x3 matrix in pixels for every row")
    pinhole_B33 = torch.zeros_like(K_B33)
    pinhole_B33[:, :2, 2] = K_B33[:, :2, 2]
    pinhole_B33[:, [0, 1], [0, 1]] = K_B33[:, [0, 1], [0, 1]]
    pinhole_B33[:, 2, 2] = 1
    if not pinhole_B33.equal(K_B33) or (K_B33[:, [0, 1], [0, 1]] <= 0).any():
        raise ValueError(
            f"{name} is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels with fx, fy > 0; rectify its "
            f"images, and of turned or mirrored ones give the K of the image as it is delivered"
        )
    pinhole_B33[:, :2, 2] += 0.5
    return pinhole_B33


def crop_intrinsics(K_B33: Tensor, windows: CropWindows) -> Tensor:
    """K (B, 3, 3) of whole images -> that of their windows."""
    offsets_B2 = windows.offsets.flip(1).to(K_B33)
    K_B33 = K_B33.expand(len(offsets_B2), 3, 3).clone()
    K_B33[:, :2, 2] -= offsets_B2
    return K_B33


def resize_intrinsics(K_B33: Tensor, old_size: tuple[int, int], new_size: tuple[int, int]) -> Tensor:
    """K (B, 3, 3) of images of ``old_size`` (height, width) -> of the same stretched to ``new_size``."""
    (old_height, old_width), (new_height, new_width) = old_size, new_size
    return K_B33 * K_B33.new_tensor([[new_width / old_width], [new_height / old_height], [1]])


def back_project(depth_BRR: Tensor, K_B33: Tensor) -> Tensor:
    """(B, R, R) metres along the optical axis -> (B, R, R, 3) metres, x right, y down, z forward.

    These are the scene's points at the pixels' centres. No matrix product, which autocast would round.
    """
    centers_R = torch.arange(depth_BRR.shape[-1], device=depth_BRR.device) + 0.5
    focal_B2, principal_B2 = K_B33[:, [0, 1], [0, 1]], K_B33[:, :2, 2]
    slopes_B2R = (centers_R - principal_B2[..., None]) / focal_B2[..., None]
    x_BRR, y_BRR = slopes_B2R[:, 0, None, :] * depth_BRR, slopes_B2R[:, 1, :, None] * depth_BRR
    return torch.stack([x_BRR, y_BRR, depth_BRR], dim=-1)
