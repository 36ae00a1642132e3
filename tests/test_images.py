from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor
from transformers import AutoImageProcessor

from lerobot_bomb.vlm.images import crop, lanczos_weights, resize, resized_pixels

SIZES = [
    (84, 84),
    (96, 96),
    (128, 128),
    (230, 230),
    (256, 256),
    (315, 315),
    (480, 640),
    (512, 512),
    (700, 90),
]
LEVEL = 1 / 255


def images(height: int, width: int) -> dict[str, np.ndarray]:
    """(height, width, 3) uint8: noise, noise of black and white (most overshoot), and gradients."""
    random = np.random.default_rng(0)
    x, y = np.meshgrid(np.linspace(0, 255, width), np.linspace(0, 255, height))
    return {
        "noise": random.integers(0, 256, (height, width, 3), dtype=np.uint8),
        "black and white": random.integers(0, 2, (height, width, 3), dtype=np.uint8) * 255,
        "gradients": np.stack([x, y, 255 - x], axis=-1).astype(np.uint8),
    }


def to_tensor(image: np.ndarray) -> Tensor:
    """Return the image as a dataset delivers it: (1, 3, H, W) in [0, 1]."""
    return torch.from_numpy(image).permute(2, 0, 1)[None] / 255


def seen_pixels(images: Tensor, crop_fraction: float, size: int, generator: torch.Generator | None) -> Tensor:
    """(B, 3, H, W) in [0, 1] -> (B, 3, size, size) in [-1, 1], as a SmolVLM sees it."""
    return resized_pixels(crop(images, crop_fraction, generator), size)


def processed(processor: Any, image: np.ndarray) -> Tensor:
    """(1, 3, 512, 512) in [-1, 1] of the real processor, without tiling."""
    images = [Image.fromarray(image)]
    pixels = processor(images, do_resize=False, do_image_splitting=False, return_tensors="pt")["pixel_values"]
    return pixels[0]


def assert_equal_pixels(ours: Tensor, theirs: Tensor) -> None:
    """Check pixels in [-1, 1]: nowhere off by more than a level, nearly everywhere by nothing."""
    difference = (ours - theirs).abs() / 2
    assert ours.shape == theirs.shape
    assert difference.max() < 1.001 * LEVEL
    assert (difference > 0.001 * LEVEL).float().mean() < 0.01


@pytest.fixture(scope="module")
def processor(shared_data: Path) -> Any:
    return AutoImageProcessor.from_pretrained(str(shared_data / "SmolVLM2-500M-Video-Instruct"))


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_pixels_are_the_real_processors(processor: Any, height: int, width: int) -> None:
    for image in images(height, width).values():
        ours = seen_pixels(to_tensor(image), 1.0, 512, None)
        assert_equal_pixels(ours, processed(processor, image))


def test_cropped_pusht_frames_are_the_real_processors(processor: Any, shared_data: Path) -> None:
    zarr = pytest.importorskip("zarr")
    replay = zarr.open(store=str(shared_data / "pusht" / "pusht_cchi_v7_replay.zarr"), mode="r")
    for index in (0, 1000, 25_000):
        frame = np.asarray(replay["data/img"][index]).astype(np.uint8)
        ours = seen_pixels(to_tensor(frame), 0.875, 512, None)
        assert_equal_pixels(ours, processed(processor, frame[6:90, 6:90].copy()))


@pytest.mark.parametrize("size", [40, 96, 128])
def test_resizing_is_pillows(size: int) -> None:
    """Check smaller, equal and larger sizes; this needs no data."""
    for image in images(96, 60).values():
        expected = Image.fromarray(image).resize((size, size), Image.Resampling.LANCZOS)
        assert_equal_pixels(resize(to_tensor(image), size) * 2, to_tensor(np.array(expected)) * 2)


def test_precision_does_not_depend_on_autocast_or_inference_mode() -> None:
    images = torch.rand(2, 3, 50, 70, generator=torch.Generator().manual_seed(0))
    expected = seen_pixels(images, 0.9, 64, None)
    lanczos_weights.cache_clear()
    with torch.autocast("cpu", dtype=torch.bfloat16), torch.inference_mode():
        pixels = seen_pixels(images, 0.9, 64, None)
    assert pixels.dtype == torch.float32
    assert torch.equal(pixels, expected)
    assert torch.equal(seen_pixels(images, 0.9, 64, None), expected)


def test_the_callers_images_stay_as_they_are() -> None:
    images = torch.rand(1, 3, 16, 16)
    before = images.clone()
    seen_pixels(images, 1.0, 16, None)
    assert torch.equal(images, before)


# Crop


def test_the_centre_is_cropped_without_a_generator() -> None:
    image = torch.zeros(1, 3, 8, 8)
    image[..., 2:6, 2:6] = 1.0
    cropped = seen_pixels(image, 0.5, 4, None)
    assert torch.equal(cropped, torch.ones(1, 3, 4, 4))


def test_pixels_are_mapped_to_minus_one_to_one() -> None:
    levels = torch.tensor([0.0, 51 / 255, 1.0]).view(3, 1, 1, 1).expand(3, 3, 5, 7)
    pixels = seen_pixels(levels, 1.0, 4, None)
    assert pixels[:, 0, 0, 0].tolist() == pytest.approx([-1.0, -0.6, 1.0], abs=1e-6)
    assert pixels.shape == (3, 3, 4, 4)


def test_random_crops_differ_by_image_and_reach_every_corner() -> None:
    ramp = (torch.arange(10.0)[:, None] * 10 + torch.arange(10.0)) / 99
    images = ramp.expand(200, 3, 10, 10)
    crops = seen_pixels(images, 0.8, 8, torch.Generator().manual_seed(0))
    corners = ((crops[:, 0, 0, 0] * 0.5 + 0.5) * 99).round().long()
    assert set(corners.tolist()) == {10 * row + column for row in range(3) for column in range(3)}
