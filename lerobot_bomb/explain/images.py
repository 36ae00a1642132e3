"""Parts of an image that are taken out, and the pixels in their place.

Shapes: `M` masks, `H`, `W` of an image in pixels.
"""

import torch
from torch import Tensor
from torchvision.transforms.functional import gaussian_blur

from lerobot_bomb.flags import one_of

FILLINGS = ("mean", "blur", "other")


def patch_masks(grid: int, height: int, width: int) -> Tensor:
    """(grid * grid, H, W) bool, the cells of a grid over an image, line by line.

    Raises:
        ValueError: the grid does not divide the image.
    """
    if grid < 1 or height % grid or width % grid:
        raise ValueError(
            f"--grid={grid} does not divide an image of {height} x {width} pixels; give a divisor of both"
        )
    line_H = torch.arange(height) // (height // grid)
    column_W = torch.arange(width) // (width // grid)
    cell_HW = grid * line_H[:, None] + column_W
    return cell_HW == torch.arange(grid**2)[:, None, None]


def filling(image_3HW: Tensor, kind: str, blur_px: float, other_3HW: Tensor | None = None) -> Tensor:
    """(3, H, W) pixels that replace those taken out of an image.

    ``mean``: the image's mean colour. ``blur``: the image, blurred by a Gaussian of this standard deviation.
    ``other``: another image.

    Raises:
        ValueError: the kind is unknown, or the other image is missing or has another size.
    """
    one_of("--fill", kind, FILLINGS)
    if kind == "mean":
        return image_3HW.mean(dim=(1, 2), keepdim=True).expand_as(image_3HW)
    if kind == "blur":
        side = min(image_3HW.shape[1:])
        reach = min(round(3 * blur_px), (side - 1) // 2)  # reflection at an edge needs as many pixels
        return gaussian_blur(image_3HW, [2 * reach + 1] * 2, [blur_px] * 2)
    if other_3HW is None or other_3HW.shape != image_3HW.shape:
        raise ValueError("--fill=other needs an image of another episode, of the same size")
    return other_3HW


def occluded(image_3HW: Tensor, masks_MHW: Tensor, filling_3HW: Tensor) -> Tensor:
    """(M, 3, H, W) copies of the image, each without the pixels of one mask."""
    return torch.where(masks_MHW[:, None], filling_3HW, image_3HW)
