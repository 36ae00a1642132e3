"""Camera images -> inputs of a vision model, on tensors.

They go straight to the model's size; the stock detour over 2048 pixels is meant for tiles.

Shapes: `B` images, `H` and `W` their sides, `S` side of the model's input, all in pixels; `P` tokens of an
image, `E` size of their embeddings.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import torch
from torch import Tensor

LANCZOS_LOBES = 3


class ImageEncoder(Protocol):
    """The part of a backbone that turns images into embeddings."""

    def pixels(self, images_B3HW: Tensor) -> Tensor:
        """(B, 3, H, W) in [0, 1] -> (B, 3, S, S), as `embed_images` takes them."""
        ...

    def embed_images(self, pixels_B3SS: Tensor) -> Tensor:
        """(B, 3, S, S) -> (B, P, E)."""
        ...


def encode_images(encoder: ImageEncoder, cameras: Sequence[Tensor]) -> Tensor:
    """Each camera's images (B, 3, H, W) in [0, 1] -> (B, P of all cameras, E)."""
    pixels = torch.stack([encoder.pixels(images_B3HW) for images_B3HW in cameras], dim=1)
    features = encoder.embed_images(pixels.flatten(0, 1))
    return features.reshape(len(pixels), -1, features.shape[-1])


@dataclass(frozen=True)
class CropWindows:
    """Crop windows of a batch of images, in their pixels; all are equally large."""

    offsets: Tensor  # (B, 2) integers: first line and first column of each window
    height: int
    width: int
    image_size: tuple[int, int]  # height, width of the whole images

    def cut(self, images_BxHW: Tensor) -> Tensor:
        """(B, ..., H, W) -> (B, ..., height, width): images, or values of the same pixels such as depth."""
        offsets = self.offsets.tolist()
        return torch.stack(
            [
                image[..., top : top + self.height, left : left + self.width]
                for image, (top, left) in zip(images_BxHW, offsets, strict=True)
            ]
        )


def draw_windows(images_BxHW: Tensor, crop_fraction: float, generator: torch.Generator | None) -> CropWindows:
    """Draw windows of ``crop_fraction`` of either side of (B, ..., H, W) images.

    Each is placed by ``generator``, or at the centre if that is None.
    """
    height, width = images_BxHW.shape[-2:]
    crop_height, crop_width = max(1, round(height * crop_fraction)), max(1, round(width * crop_fraction))
    room = torch.tensor([height - crop_height, width - crop_width])
    if generator is None:
        offsets_B2 = (room // 2).expand(len(images_BxHW), 2)
    else:
        offsets_B2 = (torch.rand(len(images_BxHW), 2, generator=generator) * (room + 1)).long()
    return CropWindows(offsets_B2, crop_height, crop_width, (height, width))


def crop(images_BxHW: Tensor, crop_fraction: float, generator: torch.Generator | None) -> Tensor:
    """Crop (B, ..., H, W) images to the windows of `draw_windows`."""
    return draw_windows(images_BxHW, crop_fraction, generator).cut(images_BxHW)


def resized_pixels(images_B3HW: Tensor, size: int) -> Tensor:
    """(B, 3, H, W) in [0, 1] -> (B, 3, size, size) in [-1, 1]; see `resize`.

    SmolVLM's own processor does this with ``do_resize=False, do_image_splitting=False``.
    """
    return _resized_levels(images_B3HW, size).mul_(2 / 255).sub_(1)


def resize(images_B3HW: Tensor, size: int) -> Tensor:
    """(B, 3, H, W) in [0, 1] -> (B, 3, size, size) in [0, 1], as Pillow's Lanczos filter does it.

    ``AutoProcessor`` uses that for SmolVLM; bicubic differs by up to 24 levels. Lines are resampled first,
    then columns, each by a product with a fixed matrix. As in Pillow, both results are 8-bit levels, so
    overshoot at edges is cut off in between. Images that are not square are stretched. The result is
    Pillow's, but for a level where rounding is a tie.
    """
    return _resized_levels(images_B3HW, size).div_(255)


def _resized_levels(images_B3HW: Tensor, size: int) -> Tensor:
    height, width = images_B3HW.shape[-2:]
    device = images_B3HW.device
    across_SW, down_SH = lanczos_weights(width, size, device), lanczos_weights(height, size, device)
    with torch.autocast(device.type, enabled=False):
        lines_B3HS = _round_levels(images_B3HW.to(across_SW.dtype) @ (255 * across_SW).T)
        return _round_levels(down_SH @ lines_B3HS).float()


def _round_levels(levels: Tensor) -> Tensor:
    """Round to whole numbers in 0..255, upwards from the middle between two; in place."""
    return levels.add_(0.5).floor_().clamp_(0, 255)


@lru_cache(maxsize=64)
def lanczos_weights(old_size: int, new_size: int, device: torch.device) -> Tensor:
    """Matrix (new_size, old_size) that resamples a line of pixels; its rows sum to 1.

    When a line shrinks, the filter is widened by as much. On CUDA the matrix is float64: LeRobot allows TF32
    there, whose rounding would be off by two levels.
    """
    scale = old_size / new_size  # old pixels per new one
    centres_N1 = (torch.arange(new_size, dtype=torch.float64)[:, None] + 0.5) * scale
    distances_NO = (torch.arange(old_size) + 0.5 - centres_N1) / max(scale, 1.0)
    lanczos_NO = torch.sinc(distances_NO) * torch.sinc(distances_NO / LANCZOS_LOBES)
    weights_NO = lanczos_NO.where(distances_NO.abs() < LANCZOS_LOBES, 0)
    weights_NO /= weights_NO.sum(dim=1, keepdim=True)
    return weights_NO.to(torch.float64 if device.type == "cuda" else torch.float32).to(device)
