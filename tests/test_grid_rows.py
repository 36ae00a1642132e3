"""Embedding and head rows that move with their cells from one grid to another."""

import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn.functional import pad

from lerobot_bomb.actions.grid_edges import gaussian_cut
from lerobot_bomb.actions.grid_rows import interpolate_rows
from lerobot_bomb.actions.grid_settings import ActionGroup, GridSettings, default_groups
from lerobot_bomb.actions.grids import ActionGrids

TOY_BINS = (4, 6, 3)
TOY_RANGES = {"theta": (0, math.pi), "phi": (-math.pi, math.pi), "r": (0, math.sqrt(3))}


def grid_of_edges(*edges: list[float]) -> ActionGrids:
    """One identity group with these edges."""
    bins = tuple(len(axis_edges) - 1 for axis_edges in edges)
    grids = ActionGrids(GridSettings((ActionGroup(tuple(range(len(bins))), "identity", bins),)), len(bins))
    return ActionGrids.from_dict({**grids.to_dict(), "edges": list(edges)}, len(bins))


def middles(grids: ActionGrids) -> list[Tensor]:
    return [((edges[:-1] + edges[1:]) / 2).float() for edges in grids.group_edges(0)]


def rows_of(grids: ActionGrids, seed: int = 0) -> Tensor:
    return torch.randn(grids.num_tokens, 5, generator=torch.Generator().manual_seed(seed))


def fitted(actions: Tensor, **changes: Any) -> ActionGrids:
    num_dims = actions.shape[1]
    groups = default_groups(num_dims, layout="pose" if num_dims == 7 else None)
    grids = ActionGrids(GridSettings(**{"groups": groups, **changes}), num_dims)
    grids.fit(actions.clamp(-1, 1))
    return grids


def actions_of(seed: int, mean: float = 0.0) -> Tensor:
    return mean + 0.4 * torch.randn(4000, 7, generator=torch.Generator().manual_seed(seed))


def test_one_coordinate_by_hand() -> None:
    old, new = grid_of_edges([-1, -0.2, 0.2, 1]), grid_of_edges([-1, -0.4, 0.1, 1])  # -.6 0 .6, -.7 -.15 .55
    moved = interpolate_rows(old, new, torch.tensor([[0.0], [1.0], [4.0]]))
    assert moved[:, 0].tolist() == pytest.approx([0, 0.75, 3.75], abs=1e-6)
    finer = grid_of_edges([-1, -0.9, 0.3, 0.5, 0.9, 1])  # -.95 -.3 .4 .7 .95
    moved = interpolate_rows(old, finer, torch.tensor([[0.0], [1.0], [4.0]]))
    assert moved[:, 0].tolist() == pytest.approx([0, 0.5, 3, 4, 4], abs=1e-6)


@pytest.fixture(scope="session")
def toys(shared_data: Path) -> tuple[ActionGrids, ActionGrids]:
    """The translation grids of Bridge and of Fractal, coarse, their ranges laid on [-1, 1]."""

    def toy(name: str) -> ActionGrids:
        parameters = json.loads((shared_data / "spatialvla" / name).read_text())
        edges = []
        for (key, (low, high)), bins in zip(TOY_RANGES.items(), TOY_BINS, strict=True):
            cut = gaussian_cut(parameters[key]["mu"], parameters[key]["sigma"], low, high, bins)
            edges.append((2 * (cut.edges - low) / (high - low) - 1).tolist())
        return grid_of_edges(*edges)

    return toy("gs_bridge.json"), toy("gs_fractal.json")


def in_the_original_order(old: ActionGrids, new: ActionGrids, rows: Tensor) -> Tensor:
    """Move rows as the original does: their order is theta, phi, rho, the lattice's phi, theta, rho."""
    theta, phi, rho = old.groups[0].bins
    lattice = pad(rows.view(phi, theta, rho, -1).movedim(-1, 0)[None], (1,) * 6, mode="replicate")[0].movedim(
        0, -1
    )
    points = [torch.cat([torch.tensor([-1.0]), inner, torch.tensor([1.0])]) for inner in middles(old)]
    for axis, coordinate in enumerate((1, 0, 2)):
        to, at = middles(new)[coordinate], points[coordinate]
        upper = torch.searchsorted(at, to).clamp(1, len(at) - 1)
        share = ((to - at[upper - 1]) / (at[upper] - at[upper - 1])).view([-1] + [1] * (3 - axis))
        lattice = (1 - share) * lattice.index_select(axis, upper - 1) + share * lattice.index_select(
            axis, upper
        )
    return lattice.reshape(-1, rows.shape[1])


def test_rows_move_on_the_lattice_that_they_lie_on(toys: tuple[ActionGrids, ActionGrids]) -> None:
    """Each row is its cell's own coordinates, so the right answer is known; errors in shares of a range."""
    for old, new, untouched in ((*toys, 0.056), (*toys[::-1], 0.056)):
        rows, expected = (torch.cartesian_prod(*middles(grids)) for grids in (old, new))

        def mean_error(moved: Tensor, expected: Tensor = expected) -> float:
            return (moved - expected).abs().mean().item() / 2

        assert mean_error(interpolate_rows(old, new, rows)) <= 0.015
        assert mean_error(rows) == pytest.approx(untouched, abs=1e-3)
        assert mean_error(in_the_original_order(old, new, rows)) > 0.070
        torch.testing.assert_close(in_the_original_order(old, old, rows), rows)  # equal grids hide it


@pytest.mark.parametrize("zero_radius_bin", [True, False])
def test_equal_grids_change_nothing(zero_radius_bin: bool) -> None:
    grids = fitted(actions_of(0), zero_radius_bin=zero_radius_bin)
    rows = rows_of(grids)
    assert torch.equal(interpolate_rows(grids, grids, rows), rows)
    half = rows.to(torch.bfloat16)
    assert torch.equal(interpolate_rows(grids, grids, half), half)


def test_binary_rows_stay_and_every_group_moves_by_itself() -> None:
    old, new = fitted(actions_of(0)), fitted(actions_of(1, mean=0.2))
    rows = torch.cat([torch.full((num,), float(i)) for i, num in enumerate(old.num_cells)])[:, None]
    rows[-2:] = torch.tensor([[7.0], [8.0]])
    moved = interpolate_rows(old, new, rows)
    assert torch.equal(moved, rows)
    assert not torch.equal(interpolate_rows(old, new, rows_of(old))[:-2], rows_of(old)[:-2])


def test_rows_of_opposite_directions_do_not_mix_across_the_cut() -> None:
    """A function that goes round with phi, between grids that cut phi elsewhere."""
    bins = (ActionGroup((0, 1, 2), "polar", (2, 32, 2)),)
    old, new = (
        fitted(way * (torch.tensor([0.5, 0, 0]) + 0.3 * actions_of(0)[:, :3]), groups=bins) for way in (1, -1)
    )
    cuts = [grids.group_edges(0)[1][0].item() % (2 * math.pi) for grids in (old, new)]
    assert cuts[0] == pytest.approx(math.pi, abs=0.1) and min(cuts[1], 2 * math.pi - cuts[1]) < 0.1

    def round_rows(grids: ActionGrids) -> Tensor:
        phi = middles(grids)[1]
        return torch.stack([phi.cos(), phi.sin()], dim=-1)[None, :, None].expand(2, 32, 2, 2).reshape(-1, 2)

    moved, expected = interpolate_rows(old, new, round_rows(old)), round_rows(new)
    error = (moved - expected).view(2, 32, 2, 2)[1, :, 1].norm(dim=-1)
    widest = old.group_edges(0)[1].diff().max().item()
    assert error.max() <= 1 - math.cos(widest / 2) + 1e-5  # the sagitta of a chord


def test_no_motion_takes_the_row_that_meant_it() -> None:
    kinds = {kind: fitted(actions_of(0), zero_radius_bin=kind) for kind in (True, False)}
    still = torch.zeros(1, 7)
    for old, new in ((kinds[False], kinds[True]), (kinds[True], kinds[True])):
        rows = rows_of(old)
        meant = old.encode(still)[0, 0]
        assert torch.equal(interpolate_rows(old, new, rows)[0], rows[meant])
    # and none of the others takes anything from it
    rows = torch.zeros(kinds[True].num_tokens, 1)
    rows[0:4096:8] = 1.0
    assert interpolate_rows(kinds[True], kinds[False], rows).abs().max() == 0
    moved = interpolate_rows(kinds[True], fitted(actions_of(3, mean=0.2)), rows)
    assert torch.equal(moved, rows)


def test_grids_of_other_groups_are_refused() -> None:
    old, other = fitted(actions_of(0)), fitted(actions_of(0)[:, :4])
    with pytest.raises(ValueError, match=r"--policy.action_groups: the checkpoint's groups are .*polar"):
        interpolate_rows(old, other, rows_of(old))
    with pytest.raises(ValueError, match="the old grid has 8194 cells, but there are 8193 rows"):
        interpolate_rows(old, old, rows_of(old)[1:])
