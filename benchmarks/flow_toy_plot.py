"""Samples in the plane as clouds of dots: a row for each word, a column for the data and each variant."""

import argparse
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import torch
from machine import writable
from PIL import Image, ImageDraw
from torch import Tensor

from lerobot_bomb.viewing.sheet import GAP, INK, TILE_PAPER, TITLE_SIZE, Sheet, font

SUFFIXES = ".png", ".jpg"
TILE_SIZE = 190  # pixels
SCALE = 3  # drawn so many times as large, then shrunk
HALF_RANGE = 1.9  # a tile shows this far to every side of the origin
DOT_RADIUS = 0.7  # pixels
DATA_RGB, SAMPLE_RGB, RING_RGB = (95, 100, 110), (30, 90, 190), (215, 60, 40)

Clouds = dict[str, Tensor]  # word -> (N, 2)


def plot(text: str) -> Path:
    """Parse the path of a plot that can be written."""
    path = writable(text)
    if path.suffix.lower() not in SUFFIXES:
        raise argparse.ArgumentTypeError(f"{text!r} must end in {' or '.join(SUFFIXES)}")
    return path


def near_modes(points_N2: Tensor, modes_M2: Tensor, radius: float) -> Tensor:
    """(M, N) bool: which points are near each mode."""
    return torch.cdist(modes_M2, points_N2) < radius


def draw_plot(path: Path, columns: dict[str, Clouds], modes_M2: Tensor, radius: float) -> None:
    """Write a plot: rings of ``radius`` around the modes, and the share of the points in each.

    Columns have the same words; the first is the data.
    """
    title = f"By the word (rows) and what was trained; rings and shares: points within {radius:g} of a mode"
    plots = {
        f'"{word}"': [
            _tile(clouds[word], modes_M2, radius, SAMPLE_RGB if column else DATA_RGB)
            for column, clouds in enumerate(columns.values())
        ]
        for word in next(iter(columns.values()))
    }
    iio.imwrite(path, Sheet(title, [*columns], images=plots).draw())


def _tile(points_N2: Tensor, modes_M2: Tensor, radius: float, rgb: tuple[int, int, int]) -> np.ndarray:
    """Draw a tile, (TILE_SIZE, TILE_SIZE, 3) uint8."""
    large = Image.new("RGB", (SCALE * TILE_SIZE, SCALE * TILE_SIZE), TILE_PAPER)
    pen = ImageDraw.Draw(large)
    for place in _places(points_N2, SCALE):
        pen.circle(place, SCALE * DOT_RADIUS, rgb)
    for place in _places(modes_M2, SCALE):
        pen.circle(place, SCALE * radius / HALF_RANGE * TILE_SIZE / 2, outline=RING_RGB, width=SCALE)
    tile = large.resize((TILE_SIZE, TILE_SIZE), Image.Resampling.LANCZOS)
    shares = near_modes(points_N2, modes_M2, radius).float().mean(dim=1).tolist()
    for (x, _), share in zip(_places(modes_M2), shares, strict=True):
        ImageDraw.Draw(tile).text((x, TILE_SIZE - 2 * GAP), f"{share:.1%}", INK, font(TITLE_SIZE), "ms")
    return np.asarray(tile)


def _places(points_N2: Tensor, scale: int = 1) -> list[tuple[float, float]]:
    """Return pixels, x to the right and y downwards; the plane's y counts upwards."""
    half = scale * TILE_SIZE / 2
    return [((1 + x / HALF_RANGE) * half, (1 - y / HALF_RANGE) * half) for x, y in points_N2.tolist()]
