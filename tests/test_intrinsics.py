"""Cameras that follow cropped and resized images."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from lerobot_bomb.vlm.depth import lattice_points
from lerobot_bomb.vlm.images import crop, draw_windows, resized_pixels
from lerobot_bomb.vlm.intrinsics import (
    back_project,
    crop_intrinsics,
    default_intrinsics,
    from_pixel_centers,
    resize_intrinsics,
)


def camera(focal_x: float, focal_y: float, center_x: float, center_y: float) -> Tensor:
    return torch.tensor([[[focal_x, 0, center_x], [0, focal_y, center_y], [0, 0, 1.0]]])


def test_the_default_camera_is_the_published_one(shared_data: Path) -> None:
    published = json.loads((shared_data / "spatialvla" / "intrinsics.json").read_text())["default"]
    size = published["height"], published["width"]
    assert torch.allclose(default_intrinsics(*size)[0], torch.tensor(published["intrinsic"]), rtol=1e-6)


def test_the_default_camera_is_stretched_to_the_image() -> None:
    expected = camera(218.2558, 291.0077, 111.8254, 111.7877)
    assert torch.allclose(default_intrinsics(224, 224), expected, rtol=0, atol=1e-4)


def test_a_point_lies_behind_the_centre_of_its_cell() -> None:
    """The first of 32x32 cells of 224x224 pixels has its centre at (3.5, 3.5)."""
    points = lattice_points(torch.full((1, 224, 224), 1.5), default_intrinsics(224, 224), 32)
    assert points[0, 0, 0].tolist() == pytest.approx([-0.744484, -0.558169, 1.5], abs=1e-6)


def test_observed_cameras_count_from_a_pixels_centre() -> None:
    assert from_pixel_centers(camera(9, 8, 3.5, 1.5), "K").equal(camera(9, 8, 4, 2))


@settings(max_examples=50, deadline=None)
@given(
    data=st.data(),
    focal=st.floats(20, 900),
    sides=st.tuples(st.integers(20, 90), st.integers(20, 90)),
    new_sides=st.tuples(st.integers(4, 200), st.integers(4, 200)),
    fraction=st.floats(0.3, 1),
    seed=st.integers(0, 2**31),
)
def test_a_camera_projects_to_where_cropping_and_resizing_move_the_pixel(
    data: Any, focal: float, sides: Any, new_sides: Any, fraction: float, seed: int
) -> None:
    x, y, z = (data.draw(st.floats(low, high)) for low, high in ((-2, 2), (-2, 2), (0.1, 9)))
    K = camera(focal, 1.1 * focal, 0.4 * sides[1], 0.6 * sides[0])
    windows = draw_windows(torch.empty(1, *sides), fraction, torch.Generator().manual_seed(seed))
    ((top, left),) = windows.offsets.tolist()
    column, row = focal * x / z + 0.4 * sides[1], 1.1 * focal * y / z + 0.6 * sides[0]
    moved = [(column - left) * new_sides[1] / windows.width, (row - top) * new_sides[0] / windows.height]
    new_K = resize_intrinsics(crop_intrinsics(K, windows), (windows.height, windows.width), new_sides)
    projected = new_K[0] @ torch.tensor([x, y, z])
    assert (projected[:2] / projected[2]).tolist() == pytest.approx(moved, rel=1e-4, abs=1e-2)


def test_a_camera_projects_to_where_a_spot_of_the_image_is_seen() -> None:
    """Through the very pixels of random crops: spot and camera must agree to a tenth of a pixel."""
    K = camera(90, 80, 45, 33).repeat(8, 1, 1)
    point = torch.tensor([0.1, 0.05, 1.2])
    column, row = (K[0] @ point)[:2] / point[2] - 0.5  # whole numbers are pixels' centres
    rows, columns = torch.arange(60)[:, None], torch.arange(80)
    spot = torch.exp(-((rows - row) ** 2 + (columns - column) ** 2) / 18)
    images = spot.expand(8, 3, 60, 80)
    windows = draw_windows(images, 0.8, torch.Generator().manual_seed(3))
    assert len(windows.offsets.unique(dim=0)) > 4
    cropped = crop(images, 0.8, torch.Generator().manual_seed(3))
    pixels = resized_pixels(cropped, 100)[:, 0] / 2 + 0.5
    centers = torch.arange(100) + 0.5
    weights = pixels.sum(dim=(1, 2))
    seen = torch.stack([pixels.sum(dim=1) @ centers, pixels.sum(dim=2) @ centers], dim=1) / weights[:, None]
    new_K = resize_intrinsics(crop_intrinsics(K, windows), (windows.height, windows.width), (100, 100))
    projected = new_K @ point
    assert torch.allclose(seen, projected[:, :2] / projected[:, 2:], atol=0.1)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31), size=st.integers(1, 12))
def test_back_projected_points_project_to_the_centres_of_their_pixels(seed: int, size: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    depth = torch.rand(2, size, size, generator=generator) * 9 + 0.1
    K = torch.cat([camera(30, 50, 4, 7), camera(9, 8, -3, 2)])
    projected = torch.einsum("bij,brcj->brci", K, back_project(depth, K))
    rows, columns = torch.meshgrid(torch.arange(size) + 0.5, torch.arange(size) + 0.5, indexing="ij")
    assert torch.allclose(projected[..., 0] / depth, columns.expand_as(depth), atol=1e-3)
    assert torch.allclose(projected[..., 1] / depth, rows.expand_as(depth), atol=1e-3)


def test_depth_is_not_blended_across_edges() -> None:
    depth = torch.ones(1, 15, 15)
    depth[..., 7:] = 3  # within the middle one of 3x3 cells
    assert lattice_points(depth, camera(9, 9, 7, 7), 3)[0, :, :, 2].tolist() == [[1, 3, 3]] * 3
