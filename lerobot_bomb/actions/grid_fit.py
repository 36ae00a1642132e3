"""Grids from data: a dataset's normalised actions, and the cuts that fit them.

Shapes: `N` samples, `D` action dims.
"""

import math

import numpy as np
import torch
from torch import Tensor

from lerobot_bomb.actions.grid_edges import MIN_WIDTH, Cut, circular_mean, cut, to_polar, unrolled
from lerobot_bomb.actions.grid_settings import ActionGroup, GridSettings
from lerobot_bomb.finite import require_finite_rows

MIN_RHO = 1e-3  # a shorter motion has no direction to fit, where there is no bin for "no motion"
REST_SHARE = 0.02  # of the length of long motions: a shorter motion is "no motion", unless a length is given
LONG_MOTION = 0.95  # quantile of the motions' lengths
EQUAL_BOUNDS = 1e-8  # LeRobot's width of a dimension whose bounds are equal


def normalised(actions_ND: np.ndarray, low_D: np.ndarray, high_D: np.ndarray) -> np.ndarray:
    """Actions -> float64 in which low is -1 and high is 1, as in LeRobot's normaliser; not clipped."""
    width_D = np.where(high_D == low_D, EQUAL_BOUNDS, high_D - low_D)
    return 2 * (actions_ND.astype(np.float64) - low_D) / width_D - 1


def normalised_rest(low_D: np.ndarray, high_D: np.ndarray) -> np.ndarray:
    """(D,) normalised action 0, the "no motion" of relative actions; 0 if it is out of range."""
    inside_D = (low_D < 0) & (high_D > 0)
    return np.where(inside_D, normalised(np.zeros((1, len(low_D))), low_D, high_D)[0], 0.0)


def check_actions(actions_ND: np.ndarray | Tensor) -> Tensor:
    """Return checked actions as (N, D) float64 on the CPU.

    Raises:
        ValueError: there are none, or some are not finite.
    """
    actions_ND = torch.as_tensor(actions_ND).detach().to("cpu", torch.float64)
    if actions_ND.ndim != 2 or not len(actions_ND):
        raise ValueError(f"a grid is fitted on actions (N, D), not on shape {tuple(actions_ND.shape)}")
    require_finite_rows(actions_ND, "a grid cannot be fitted", "actions")
    return actions_ND


def fit_cuts(actions_ND: Tensor, rest_D: np.ndarray, settings: GridSettings) -> list[Cut]:
    """Fit every coordinate's cuts to actions (N, D) float64 in [-1, 1]; no samples: about equal widths."""
    rest = torch.from_numpy(rest_D)
    cuts = []
    for group in settings.groups:
        values = actions_ND[:, list(group.dims)]
        if group.transform == "polar":
            cuts += _polar_cuts(values, rest[list(group.dims)], group, settings)
        elif group.transform == "binary":
            cuts.append(cut(values[:, 0], -1, 1, 2, "uniform", settings.min_sigma))
        else:
            cuts += [
                cut(values_N, -1, 1, bins, settings.distribution, settings.min_sigma)
                for values_N, bins in zip(values.T, group.bins, strict=True)
            ]
    return cuts


def _polar_cuts(xyz_N3: Tensor, rest: Tensor, group: ActionGroup, settings: GridSettings) -> list[Cut]:
    """Fit the cuts of theta, phi and rho; motions that are too short do not count for theta and phi."""
    options = (settings.distribution, settings.min_sigma)
    theta_bins, phi_bins, rho_bins = group.bins
    theta, phi, rho = to_polar(xyz_N3 - rest).unbind(dim=-1)
    shortest = _shortest_motion(rho, settings)
    moving = rho >= shortest
    theta, phi = theta[moving], phi[moving]
    middle = circular_mean(phi) if settings.phi_fit == "wrapped" else 0.0
    low, high = middle - math.pi, middle + math.pi
    highest = float((1 + rest.abs()).norm())  # the corner of [-1, 1] that is farthest from rest
    if settings.zero_radius_bin:
        above = cut(rho[moving], shortest, highest, rho_bins - 1, *options)
        first = above.edges.new_tensor([0.0, shortest / 2])
        edges, means = torch.cat([first[:1], above.edges]), torch.cat([first[1:], above.means])
        of_rho = Cut(edges, means, above.mean, above.std)
    else:
        of_rho = cut(rho, 0, highest, rho_bins, *options)
    return [
        cut(theta, 0, math.pi, theta_bins, *options),
        cut(unrolled(phi, low, high), low, high, phi_bins, *options),
        of_rho,
    ]


def _shortest_motion(rho_N: Tensor, settings: GridSettings) -> float:
    """Return the rho below which a motion counts as none, or has no direction to fit."""
    if not settings.zero_radius_bin:
        return MIN_RHO
    return dead_radius(rho_N) if settings.rho_dead is None else settings.rho_dead


def dead_radius(rho_N: Tensor) -> float:
    """Return REST_SHARE of the length of the data's long motions, in normalised units.

    A share of the range would depend on the longest motion, so single frames would decide what rests.

    Raises:
        ValueError: so few frames set the range that no bin is narrow enough for this.
    """
    moving = rho_N[rho_N > 0]
    if not len(moving):
        return REST_SHARE
    long = float(moving.sort().values[math.ceil(LONG_MOTION * len(moving)) - 1])
    if REST_SHARE * long < MIN_WIDTH:
        farthest = rho_N.argsort(descending=True)[:3].tolist()
        raise ValueError(
            f"{LONG_MOTION:.0%} of the dataset's motions are shorter than 1/{float(moving.max()) / long:.0f} "
            f"of the longest, so single frames set the range of the normalised actions; the farthest are the "
            f"actions {', '.join(map(str, farthest))}. Leave out their episodes (lerobot-edit-dataset "
            f"--operation.type=delete_episodes), or give --policy.normalization_mapping with ACTION: "
            f"QUANTILES, or the length of no motion, --policy.rho_dead"
        )
    return REST_SHARE * long
