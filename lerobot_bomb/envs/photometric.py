"""Perturbation axis `photometric`: effects of a camera's sensor on an image."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Self

import numpy as np

from lerobot_bomb.bomb.perturbations import magnitude

NOISE_SPAN = 1 << 16  # positions in the bank of noise at which an image's noise may begin
NOISE_STRIDE = 7919  # from one image to the next; a prime
GAIN_BITS = 7  # of a gain's fraction


@dataclass(frozen=True)
class Photometric:
    """Colour balance, brightness and noise of the sensor."""

    gains: tuple[float, float, float]
    noise: float  # standard deviation in grey levels
    first: int  # where the first image's noise begins in the bank of noise

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator) -> Self:
        gains = np.full(3, 1 + rng.choice((-1.0, 1.0)) * magnitude("photometric", "brightness", level))
        gains[rng.integers(3)] *= 1 + rng.choice((-1.0, 1.0)) * magnitude("photometric", "balance", level)
        red, green, blue = map(float, gains)
        noise = magnitude("photometric", "noise", level)
        return cls((red, green, blue), noise, int(rng.integers(NOISE_SPAN)))

    def __call__(self, rgb: np.ndarray, image: int) -> np.ndarray:
        """(H, W, 3) uint8, the `image`-th image of an episode -> the image after the changes."""
        start = (self.first + image * NOISE_STRIDE) % NOISE_SPAN
        noise = _noise_bank(rgb.size, self.noise)[start : start + rgb.size].reshape(rgb.shape)
        values = rgb * _gain_table(self.gains, rgb.shape)
        values >>= GAIN_BITS
        values = values.view(np.int16)
        values += noise
        return np.clip(values, 0, 255, out=values).astype(np.uint8)


@lru_cache(maxsize=8)
def _noise_bank(size: int, std: float) -> np.ndarray:
    """(size + NOISE_SPAN,) int16 normal noise, the same in every process; drawing it per image is slow."""
    return np.rint(std * np.random.default_rng(0).standard_normal(size + NOISE_SPAN)).astype(np.int16)


@lru_cache(maxsize=8)
def _gain_table(gains: tuple[float, float, float], shape: tuple[int, int, int]) -> np.ndarray:
    """(H, W, 3) uint16 gains of an image's values, in fixed point; a full array multiplies faster."""
    return np.broadcast_to(np.rint(np.array(gains) * (1 << GAIN_BITS)).astype(np.uint16), shape).copy()
