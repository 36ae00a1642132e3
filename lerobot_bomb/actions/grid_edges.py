"""Polar coordinates, and the bins of one coordinate: their edges and means, in float64.

Shapes: `N` samples, `E` bins.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

MIN_WIDTH = 1e-4  # of a bin, in the coordinate's unit
MARGIN = 0.01  # least distance of a mean from its bin's edges, in bin widths: rounding leaves it inside


@dataclass(frozen=True)
class Cut:
    """A coordinate's bins and the Gaussian of its samples."""

    edges: Tensor  # (E + 1,) increasing by at least MIN_WIDTH
    means: Tensor  # (E,) mean value in each bin
    mean: float
    std: float


def cut(values_N: Tensor, low: float, high: float, num_bins: int, distribution: str, min_sigma: float) -> Cut:
    """Cut [low, high] into bins by the samples; without samples, into bins of about equal width.

    A standard deviation below `min_sigma` or MIN_WIDTH is raised to it: a coordinate that never changes has
    its finest bins around its value. A bin's mean is that of its samples, or of the Gaussian if it has none.
    """
    mean, std = (low + high) / 2, high - low
    if len(values_N):
        mean, std = float(values_N.mean()), float(values_N.std(correction=0))
    of_gaussian = gaussian_cut(mean, max(std, min_sigma), low, high, num_bins)
    if distribution == "gaussian":
        edges = of_gaussian.edges
    elif distribution == "quantile" and len(values_N):
        edges = _separated(_quantile_edges(values_N, low, high, num_bins))
    else:
        edges = torch.linspace(low, high, num_bins + 1, dtype=torch.float64)
    bins_N = torch.bucketize(values_N.contiguous(), edges[1:-1], right=True)
    counts = torch.bincount(bins_N, minlength=num_bins)
    means = torch.bincount(bins_N, values_N, minlength=num_bins) / counts
    means = torch.where(counts > 0, means, truncated_means(edges, of_gaussian.mean, of_gaussian.std))
    return Cut(edges, _inside(edges, means), of_gaussian.mean, of_gaussian.std)


def gaussian_cut(mean: float, std: float, low: float, high: float, num_bins: int) -> Cut:
    """Cut [low, high] into bins with equal shares of a Gaussian that is truncated to it."""
    std = max(std, MIN_WIDTH)
    ends = torch.tensor([low, high], dtype=torch.float64)
    first, last = torch.special.ndtr((ends - mean) / std).tolist()
    shares = torch.linspace(first, last, num_bins + 1, dtype=torch.float64)
    edges = (mean + std * torch.special.ndtri(shares)).clamp(low, high)
    edges[0], edges[-1] = low, high
    edges = _separated(edges)
    return Cut(edges, truncated_means(edges, mean, std), mean, std)


def _quantile_edges(values_N: Tensor, low: float, high: float, num_bins: int) -> Tensor:
    """(E + 1,) edges with equal shares of the samples between them."""
    ranked_N = values_N.sort().values  # torch.quantile refuses more than 16 million values
    position = torch.linspace(0, len(values_N) - 1, num_bins + 1, dtype=torch.float64)
    below, above = ranked_N[position.floor().long()], ranked_N[position.ceil().long()]
    edges = torch.lerp(below, above, position.frac())
    edges[0], edges[-1] = low, high
    return edges


def _separated(edges: Tensor) -> Tensor:
    """Edges moved so that every bin is at least MIN_WIDTH wide; the ends stay."""
    steps = torch.arange(len(edges), dtype=edges.dtype) * MIN_WIDTH
    highest = edges[-1] - steps.flip(0)
    return torch.minimum((edges - steps).cummax(dim=0).values + steps, highest)


def truncated_means(edges: Tensor, mean: float, std: float) -> Tensor:
    """(E + 1,) -> (E,): the mean of the Gaussian within each bin."""
    low, high = (edges[:-1] - mean) / std, (edges[1:] - mean) / std
    # far out on the right, a share is a difference of numbers near 1; mirrored, of small ones
    mirrored = low > 0
    near, far = torch.where(mirrored, -high, low), torch.where(mirrored, -low, high)
    share = torch.special.ndtr(far) - torch.special.ndtr(near)
    means = (_density(near) - _density(far)) / share
    # no share left in double precision: all of it is at the edge next to the Gaussian
    means = torch.where(share > 0, means, far)
    means = mean + std * torch.where(mirrored, -means, means)
    return _inside(edges, means)


def _inside(edges: Tensor, means: Tensor) -> Tensor:
    margin = MARGIN * edges.diff()
    return means.clamp(edges[:-1] + margin, edges[1:] - margin)


def _density(x: Tensor) -> Tensor:
    return torch.exp(-x.square() / 2) / math.sqrt(2 * math.pi)


def to_polar(xyz: Tensor) -> Tensor:
    """(..., 3) -> theta in [0, pi], phi in (-pi, pi], both radians, and rho: (..., 3)."""
    x, y, z = xyz.unbind(dim=-1)
    return torch.stack([torch.atan2(torch.hypot(x, y), z), torch.atan2(y, x), xyz.norm(dim=-1)], dim=-1)


def from_polar(polar: Tensor) -> Tensor:
    """Theta and phi in radians and rho (..., 3) -> x, y, z (..., 3)."""
    theta, phi, rho = polar.unbind(dim=-1)
    level = rho * theta.sin()
    return torch.stack([level * phi.cos(), level * phi.sin(), rho * theta.cos()], dim=-1)


def unrolled(angles: Tensor, low: float | Tensor, high: float | Tensor) -> Tensor:
    """Angles in (-pi, pi] -> the same angles in [low, high], which spans a whole turn; radians."""
    turn = 2 * math.pi
    return angles + turn * (angles < low).to(angles.dtype) - turn * (angles > high).to(angles.dtype)


def circular_mean(angles_N: Tensor) -> float:
    """Direction, in radians, of the mean of unit vectors; 0 without samples."""
    return float(torch.atan2(angles_N.sin().sum(), angles_N.cos().sum()))
