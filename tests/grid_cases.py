"""Grids on made-up actions."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from lerobot_bomb.actions.grid_settings import GridSettings, default_groups
from lerobot_bomb.actions.grids import ActionGrids


def fitted(actions: Tensor | np.ndarray, rest: Any = None, **changes: Any) -> ActionGrids:
    """Fit grids to normalised actions (N, D), with the default groups (7 dims: of a pose) unless given."""
    num_dims = actions.shape[1]
    groups = default_groups(num_dims, layout="pose" if num_dims == 7 else None)
    grids = ActionGrids(GridSettings(**{"groups": groups, **changes}), num_dims)
    grids.fit(actions, rest)
    return grids


def normal_actions(num: int, num_dims: int, seed: int = 0) -> Tensor:
    """Unequal means and spreads, clipped."""
    generator = torch.Generator().manual_seed(seed)
    steps = torch.arange(num_dims)
    actions = 0.1 * (steps % 3 - 1) + (0.2 + 0.05 * steps) * torch.randn(num, num_dims, generator=generator)
    return actions.clamp(-1, 1)


def error(grids: ActionGrids, actions: Tensor, point: str) -> Tensor:
    """(N,) distance between the first three dims of the actions and of what is decoded."""
    grids.decode_point = point
    return (grids.decode(grids.encode(actions)) - actions)[:, :3].norm(dim=1)
