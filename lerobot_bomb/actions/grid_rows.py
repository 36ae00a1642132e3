"""A checkpoint's embedding and head rows, moved from one grid to another."""

import math

import torch
from torch import Tensor

from lerobot_bomb.actions.grid_edges import unrolled
from lerobot_bomb.actions.grid_settings import FLAG
from lerobot_bomb.actions.grids import ActionGrids


@torch.no_grad()
def interpolate_rows(old: ActionGrids, new: ActionGrids, rows: Tensor) -> Tensor:
    """A row per cell of the old grid (V, H) -> a row per cell of the new one (V', H), in the rows' type.

    Linear along each coordinate between the middles of the old bins, constant beyond the outermost; phi wraps
    around. Binary groups stay unchanged, and the new cell of "no motion" takes the row of the old one.

    Raises:
        ValueError: the groups differ in dims or transform, or there are not as many rows as old cells.
    """
    if [(group.dims, group.transform) for group in old.groups] != [
        (group.dims, group.transform) for group in new.groups
    ]:
        raise ValueError(f"{FLAG}: the checkpoint's groups are {list(old.groups)}, not {list(new.groups)}")
    if len(rows) != old.num_tokens:
        raise ValueError(f"the old grid has {old.num_tokens} cells, but there are {len(rows)} rows")
    parts = [
        _move_group(old, new, i, rows[first : first + num_cells].float())
        for i, (first, num_cells) in enumerate(zip(old.offsets, old.num_cells, strict=True))
    ]
    return torch.cat(parts).to(rows.dtype)


def _move_group(old: ActionGrids, new: ActionGrids, index: int, rows: Tensor) -> Tensor:
    """(cells of the old group, H) -> (cells of the new one, H), float32."""
    group = old.groups[index]
    if group.transform == "binary":
        return rows
    lattice = rows.view(*group.bins, -1)
    edges = list(zip(old.group_edges(index), new.group_edges(index), strict=True))
    if group.transform == "identity":
        for axis, (of_old, of_new) in enumerate(edges):
            lattice = _move_axis(lattice, axis, _middles(of_old), _middles(of_new))
        return lattice.flatten(0, -2)
    theta, phi, rho = ((_middles(of_old), _middles(of_new)) for of_old, of_new in edges)
    lattice = _move_around(_move_axis(lattice, 0, *theta), 1, *phi)
    if not old.settings.zero_radius_bin:
        lattice = _move_axis(lattice, 2, *rho)
    else:  # the first bin is no motion, so no neighbour of the others
        at_rest, lattice = lattice[:, :, :1], _move_axis(lattice[:, :, 1:], 2, rho[0][1:], rho[1])
        if new.settings.zero_radius_bin:
            lattice = torch.cat([at_rest, lattice[:, :, 1:]], dim=2)
    moved = lattice.flatten(0, -2)
    if new.settings.zero_radius_bin:
        moved[0] = rows[old.encode(old.rest)[index]]
    return moved


def _middles(edges: Tensor) -> Tensor:
    return (edges[:-1] + edges[1:]) / 2


def _move_around(lattice: Tensor, axis: int, old: Tensor, new: Tensor) -> Tensor:
    """`_move_axis` for angles in radians, whose first and last bins are neighbours."""
    turn = 2 * math.pi
    old = torch.cat([old[-1:] - turn, old, old[:1] + turn])
    ends = lattice.narrow(axis, -1, 1), lattice.narrow(axis, 0, 1)
    lattice = torch.cat([ends[0], lattice, ends[1]], dim=axis)
    return _move_axis(lattice, axis, old, unrolled(new, old[0], old[-1]))


def _move_axis(lattice: Tensor, axis: int, old: Tensor, new: Tensor) -> Tensor:
    """Values at the old points of one axis -> at the new ones: linear between, constant beyond."""
    upper = torch.searchsorted(old, new).clamp(0, len(old) - 1)
    lower = (upper - 1).clamp(min=0)
    # 0 / 0 where both are the first point
    share = ((new - old[lower]) / (old[upper] - old[lower])).nan_to_num(0, 0, 0).clamp(0, 1)
    shape = [-1 if i == axis else 1 for i in range(lattice.ndim)]
    share = share.to(lattice).view(shape)
    of_lower, of_upper = (lattice.index_select(axis, index.to(lattice.device)) for index in (lower, upper))
    return (1 - share) * of_lower + share * of_upper
