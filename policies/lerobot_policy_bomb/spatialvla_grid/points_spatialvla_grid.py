"""Points in a camera's frame that ``spatialvla_grid`` sees."""

import torch
from torch import Tensor

from lerobot_bomb.vlm.depth import ZoeDepth, lattice_points, observed_depth, observed_intrinsics
from lerobot_bomb.vlm.images import CropWindows
from lerobot_bomb.vlm.intrinsics import crop_intrinsics, default_intrinsics, resize_intrinsics
from lerobot_policy_bomb.spatialvla_grid.configuration_spatialvla_grid import SpatialvlaGridConfig


def camera_points(
    config: SpatialvlaGridConfig,
    zoedepth: ZoeDepth | None,
    batch: dict[str, Tensor],
    camera: str,
    windows: CropWindows,
    pixels: Tensor,
    size: int,
) -> Tensor:
    """Return the points (B, R, R, 3), in metres, of a lattice of R = ``size`` a side; NaN: not known."""
    if config.depth_source == "none":
        return pixels.new_full((len(pixels), size, size, 3), torch.nan)
    if zoedepth is None:
        depth, default = windows.cut(observed_depth(batch, camera, windows.image_size)), None
    else:
        depth, default = zoedepth(pixels), default_intrinsics(*windows.image_size)
    intrinsics = observed_intrinsics(batch, camera, config.camera_intrinsics, default)
    intrinsics = crop_intrinsics(intrinsics.to(pixels.device), windows)
    depth_size = depth.shape[-2], depth.shape[-1]
    intrinsics = resize_intrinsics(intrinsics, (windows.height, windows.width), depth_size)
    return lattice_points(depth, intrinsics, size)
