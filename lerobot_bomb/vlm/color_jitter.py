"""Colour jitter of training images.

Source: the recipe of VLA-0 (arXiv 2510.13054), which jitters by torchvision's ``ColorJitter``.
"""

from collections.abc import Sequence
from dataclasses import astuple, dataclass

import torch
from torch import Tensor
from torchvision.transforms import functional

# in the order of the fields below
ADJUST = (
    functional.adjust_brightness,
    functional.adjust_contrast,
    functional.adjust_saturation,
    functional.adjust_hue,
)
UNCHANGED = (1.0, 1.0, 1.0, 0.0)


@dataclass(frozen=True)
class ColorJitter:
    """Colour jitter; each field x says how far its property may change, 0 not at all.

    Factors are drawn from 1 - x to 1 + x, the turn of the hue from -x to x of a full turn. They are applied
    in a random order, as torchvision's class of this name does.
    """

    brightness: float
    contrast: float
    saturation: float
    hue: float

    def __call__(self, cameras: Sequence[Tensor], generator: torch.Generator) -> list[Tensor]:
        """Change each camera's (B, 3, H, W) in [0, 1]; a sample's change is the same in all cameras."""
        changes = [self._draw(generator) for _ in range(len(cameras[0]))]
        with torch.autocast(cameras[0].device.type, enabled=False):
            return [
                torch.stack([_changed(image, change) for image, change in zip(images, changes, strict=True)])
                for images in cameras
            ]

    def _draw(self, generator: torch.Generator) -> list[tuple[int, float]]:
        """Draw which of ADJUST to apply, in this order, and by which factors."""
        reach = astuple(self)
        signed = (2 * torch.rand(len(reach), generator=generator) - 1).tolist()
        factors = [base + x * share for base, x, share in zip(UNCHANGED, reach, signed, strict=True)]
        order = torch.randperm(len(reach), generator=generator).tolist()
        return [(index, factors[index]) for index in order if reach[index]]


def _changed(image_3HW: Tensor, change: list[tuple[int, float]]) -> Tensor:
    for index, factor in change:
        image_3HW = ADJUST[index](image_3HW, factor)
    return image_3HW
