"""Report on a grid: its coordinates' names and edges, and what it clips.

Shapes: `N` actions, `D` action dims.
"""

import textwrap
from collections.abc import Collection, Sequence

import numpy as np
import torch

from lerobot_bomb.actions.grid_fit import LONG_MOTION
from lerobot_bomb.actions.grid_settings import ActionGroup
from lerobot_bomb.actions.grids import ActionGrids

CLIP_TOLERANCE = 1e-3  # LeRobot estimates quantiles: an extreme that many actions have may lie a hair beyond
LINE_WIDTH = 110  # characters
# share of a dim's actions; twice the share beyond the 1 % and 99 % quantiles
MUCH_CLIPPED = 0.04
MUCH_STOPPED = 0.5  # of the actions that move
FEW_SET_RANGE = 10  # ratio of the longest motion to the long ones


def coordinate_names(grids: ActionGrids, dim_names: Sequence[str]) -> list[str]:
    """Return the names of the coordinates of all groups."""
    return [label for group in grids.groups for label in group.coordinate_names(dim_names)]


def coordinate_edges(grids: ActionGrids) -> list[np.ndarray]:
    """(bins + 1,) edges of each coordinate of all groups."""
    return [edges.numpy() for i in range(len(grids.groups)) for edges in grids.group_edges(i)]


def edges_text(grids: ActionGrids, dim_names: Sequence[str]) -> str:
    """Write the edges of each coordinate, as lines of text."""
    labels = coordinate_names(grids, dim_names)
    lines = [
        f"{label}: {' '.join(f'{edge:.4f}' for edge in edges)}"
        for label, edges in zip(labels, coordinate_edges(grids), strict=True)
    ]
    return "\n".join(textwrap.fill(line, LINE_WIDTH, subsequent_indent="  ") for line in lines)


def clipping_text(actions_ND: np.ndarray, dim_names: Sequence[str]) -> tuple[str, bool]:
    """Describe what clipping to [-1, 1] takes from normalised actions, and whether that is much."""
    beyond_ND = (np.abs(actions_ND) - 1).clip(min=0)
    is_clipped_ND = beyond_ND > CLIP_TOLERANCE
    if not is_clipped_ND.any():
        return f"none of {len(actions_ND)} actions is beyond the grid", False
    dims = [
        f"{name} {clipped:.1%} by up to {most:.2g}"
        for name, clipped, most in zip(
            dim_names, is_clipped_ND.mean(axis=0), beyond_ND.max(axis=0), strict=True
        )
        if clipped
    ]
    text = (
        f"{is_clipped_ND.any(axis=1).sum()} of {len(actions_ND)} actions are beyond the grid and are clipped "
        f"to it, in units of half its range: {', '.join(dims)}"
    )
    is_much = bool((is_clipped_ND.mean(axis=0) > MUCH_CLIPPED).any())
    if is_much:
        text += (
            ". LeRobot averages quantiles over episodes, so that they are not the data's: `lerobot-bomb "
            "doctor dataset FOLDER --mend` makes them so. "
            "--policy.normalization_mapping with ACTION: MIN_MAX clips nothing"
        )
    return text, is_much


def rest_text(grids: ActionGrids, actions_ND: np.ndarray, dim_names: Sequence[str]) -> tuple[str, bool]:
    """Describe how many normalised actions the "no motion" cells take, and whether that needs a remedy.

    The text is empty if there is no such cell.
    """
    actions = torch.from_numpy(actions_ND)
    cells_NG, coordinates_NC = grids.encode(actions), grids.coordinates(actions.float().clamp(-1, 1))
    texts, needs_remedy, num_coordinates = [], False, 0
    for i, group in enumerate(grids.groups):
        num_coordinates += len(group.bins)
        if group.transform != "polar" or not grids.settings.zero_radius_bin:
            continue
        names = ", ".join(dim_names[dim] for dim in group.dims)
        rho_N = coordinates_NC[:, num_coordinates - 1].double().numpy()
        dead = float(grids.group_edges(i)[2][1])
        text, is_bad = _group_rest_text(rho_N, (cells_NG[:, i] == 0).numpy(), dead)
        texts.append(f"{names}: {text}")
        needs_remedy |= is_bad
    return "\n".join(texts), needs_remedy


def _group_rest_text(rho_N: np.ndarray, is_still_N: np.ndarray, dead: float) -> tuple[str, bool]:
    moves_N = rho_N > 0
    stopped = (is_still_N & moves_N).sum() / max(moves_N.sum(), 1)
    text = (
        f"{is_still_N.mean():.1%} of the actions are decoded to no motion (shorter than {dead:.2g}), "
        f"{stopped:.1%} of those that move"
    )
    is_much = bool(stopped > MUCH_STOPPED)
    if is_much:
        text += ". --policy.rho_dead=null makes it a share of the data's long motions"
    if not moves_N.any():
        return text, False
    ratio = rho_N.max() / np.quantile(rho_N[moves_N], LONG_MOTION)
    if ratio <= FEW_SET_RANGE:
        return text, is_much
    return (
        f"{text}. The longest motion is {ratio:.0f} times as long as {LONG_MOTION:.0%} of them, so that "
        f"cells are coarse there: leave such frames' episodes out, or give "
        f"--policy.grid_distribution=quantile, or "
        f"--policy.normalization_mapping with ACTION: QUANTILES"
    ), True


def cells_text(groups: Collection[ActionGroup], edges: str) -> str:
    """Describe the tokens of an action, and how many cells with which edges each chooses from."""
    cells = ", ".join(
        f"{group.transform} " * (group.transform != "identity") + " x ".join(map(str, group.bins))
        for group in groups
    )
    described = f"({cells} cells, {edges})"
    if all(len(group.dims) == 1 for group in groups):
        return f"one token per dimension {described}, not per group"
    return f"one token per group {described}"
