"""Camera images -> what a vision model reads, on tensors."""

import torch
from torch import Tensor
from torch.nn.functional import interpolate


def crop_and_resize(
    images_B3HW: Tensor, crop_fraction: float, size: int, generator: torch.Generator | None
) -> Tensor:
    """(B, 3, H, W) in [0, 1] -> (B, 3, size, size) in [-1, 1].

    Cuts a window of ``crop_fraction`` of either side, at a place of its own for every image drawn from
    ``generator``, or at the centre where that is None.
    """
    batch_size, _, height, width = images_B3HW.shape
    crop_height, crop_width = max(1, round(height * crop_fraction)), max(1, round(width * crop_fraction))
    room = torch.tensor([height - crop_height, width - crop_width])
    if generator is None:
        offsets_B2 = (room // 2).expand(batch_size, 2)
    else:
        offsets_B2 = (torch.rand(batch_size, 2, generator=generator) * (room + 1)).long()
    windows = [
        image[:, top : top + crop_height, left : left + crop_width]
        for image, (top, left) in zip(images_B3HW, offsets_B2.tolist(), strict=True)
    ]
    resized_B3SS = interpolate(
        torch.stack(windows), size=(size, size), mode="bilinear", align_corners=False, antialias=True
    )
    return (resized_B3SS - 0.5) / 0.5
