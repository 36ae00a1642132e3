"""Action grids: SpatialVLA's published ones, fitted ones, and what is decoded from them."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from grid_cases import error, fitted, normal_actions
from torch import Tensor

from lerobot_bomb.actions.grid_edges import from_polar, gaussian_cut, to_polar
from lerobot_bomb.actions.grid_settings import ActionGroup, GridSettings, default_groups
from lerobot_bomb.actions.grids import ActionGrids

PI = math.pi
XYZ = ("x", "y", "z")


@pytest.fixture(scope="session")
def bridge(shared_data: Path) -> dict[str, Any]:
    return json.loads((shared_data / "spatialvla" / "gs_bridge.json").read_text())


# The published method


def test_edges_and_points_of_a_gaussian_by_hand() -> None:
    cut = gaussian_cut(0.0, 0.3, -1.0, 1.0, 4)
    assert cut.edges.tolist() == pytest.approx([-1, -0.202144, 0, 0.202144, 1], abs=1e-6)
    assert cut.means.tolist() == pytest.approx([-0.379981, -0.097309, 0.097309, 0.379981], abs=1e-6)
    grids = ActionGrids(GridSettings((ActionGroup((0,), "identity", (4,)),), decode_point="mid"), 1)
    edges = {"edges": [cut.edges.tolist()], "means": [cut.means.tolist()], "gaussians": [[0.0, 0.3]]}
    grids = ActionGrids.from_dict({**grids.to_dict(), **edges}, 1)
    mids = grids.decode(torch.arange(4)[:, None])[:, 0]
    assert mids.tolist() == pytest.approx([-0.601072, -0.101072, 0.101072, 0.601072], abs=1e-6)


def test_polar_coordinates_by_hand() -> None:
    xyz = torch.tensor([0.3, -0.4, 0.5], dtype=torch.float64)
    assert to_polar(xyz).tolist() == pytest.approx([0.785398, -0.927295, 0.707107], abs=1e-6)
    torch.testing.assert_close(from_polar(to_polar(xyz)), xyz)


def test_the_published_bridge_grid(bridge: dict[str, Any]) -> None:
    grids = ActionGrids.from_published(bridge, decode_point="mid")
    rho = [0, 0.247153, 0.373865, 0.474155, 0.566071, 0.659176, 0.764021, 0.905077, 1.732051]
    assert grids.group_edges(0)[2].tolist() == pytest.approx(rho, abs=1e-6)
    assert (grids.num_cells, grids.offsets, grids.num_tokens) == ([4096, 4096, 2], [0, 4096, 8192], 8194)
    # the original's gripper, 0 and 1, is -1 and 1 here; 0.5 is 0
    actions = torch.tensor(
        [
            [0.3, -0.4, 0.5, 0.1, -0.2, 0.05, 1],
            [0, 0, 0, 0, 0, 0, -1],
            [1, 1, 1, -1, 1, 0.3, 0],
            [0, 0.03, -0.82, 0, -0.14, 0.57, 1],
        ]
    )
    tokens = [[69, 6712, 8193], [120, 6247, 8192], [431, 4349, 8193], [4054, 6223, 8193]]
    for dtype in (torch.float32, torch.float64):
        assert (grids.encode(actions.to(dtype)) + torch.tensor(grids.offsets)).tolist() == tokens
    decoded = grids.decode(grids.encode(actions[:2]))
    first = [0.197842, -0.257692, 0.633108, 0.118031, -0.175523, 0.032737, 1]
    second = [0.056359, 0.002587, 0.109946, 0.016386, 0.003559, -0.014128, -1]
    assert decoded[0].tolist() == pytest.approx(first, abs=1e-6)
    assert decoded[1].tolist() == pytest.approx(second, abs=1e-6)
    parts = [
        torch.stack(torch.unravel_index(cells, (16, 32, 8))).tolist() for cells in torch.tensor([69, 880])
    ]
    assert parts == [[0, 8, 5], [3, 14, 0]]


def test_the_published_grid_of_other_groups(bridge: dict[str, Any]) -> None:
    groups = (ActionGroup((0, 1, 2), "polar", (2, 2, 2)), *default_groups(7, layout="pose")[1:])
    grids = ActionGrids.from_published(bridge, groups=groups)
    assert grids.num_cells == [8, 4096, 2] and grids.settings.flags()["action_groups"]


def test_a_least_sigma_widens_the_published_grid(bridge: dict[str, Any]) -> None:
    edges = ActionGrids.from_published(bridge, min_sigma=0.5).group_edges(1)[0]
    expected = gaussian_cut(bridge["roll"]["mu"], 0.5, -1, 1, 16).edges
    torch.testing.assert_close(edges, expected.float().double())
    assert edges[8] - edges[7] > 1.2 * ActionGrids.from_published(bridge).group_edges(1)[0].diff()[7]


def test_bridge_errors_of_both_decode_points(bridge: dict[str, Any]) -> None:
    """Draw independently with the data's means and deviations; the original decodes to the middle."""
    generator = torch.Generator().manual_seed(0)
    actions = torch.zeros(400_000, 7)
    for dim, key in enumerate(XYZ):
        gaussian = bridge[key]
        actions[:, dim] = gaussian["mu"] + gaussian["sigma"] * torch.randn(len(actions), generator=generator)
    actions.clamp_(-1, 1)
    grids = ActionGrids.from_published(bridge)
    assert grids.decode_point == "cond_mean"
    default, middle = (error(grids, actions, point) for point in ("cond_mean", "mid"))
    assert middle.mean().item() == pytest.approx(0.073, abs=1e-3)
    assert default.mean().item() <= 0.061
    assert default.quantile(0.95).item() == pytest.approx(0.141, abs=2e-3)


# Round trips


def grids_of_all_kinds(bridge: dict[str, Any]) -> dict[str, ActionGrids]:
    kinds = {f"default {d}": fitted(normal_actions(20_000, d)) for d in (2, 4, 5, 7, 14)}
    for distribution in ("uniform", "quantile"):
        kinds[distribution] = fitted(normal_actions(20_000, 7), distribution=distribution)
    rest = np.array([0.4, -0.1, 0.2, 0, 0, 0, 0])
    kinds["rest"] = fitted(normal_actions(20_000, 7), rest)
    kinds["published"] = ActionGrids.from_published(bridge)
    return kinds


def test_millions_of_actions_come_back_to_their_cells(bridge: dict[str, Any]) -> None:
    total = 0
    for name, grids in grids_of_all_kinds(bridge).items():
        generator = torch.Generator().manual_seed(1)
        actions = 2.2 * torch.rand(240_000, grids.num_dims, generator=generator) - 1.1
        cells = grids.encode(actions)
        assert (cells >= 0).all() and (cells < torch.tensor(grids.num_cells)).all(), name
        for point in ("mid", "cond_mean"):
            grids.decode_point = point
            decoded = grids.decode(cells)
            inside = (decoded.abs() < 1).all(dim=1) if grids.num_dims != 7 else inside_of_pose(decoded)
            assert inside.float().mean() > 0.3, name
            again = grids.encode(decoded)
            assert torch.equal(again[inside], cells[inside]), (name, point)
            assert torch.equal(grids.decode(again)[inside], decoded[inside]), (name, point)
        total += len(actions)
    assert total >= 2_000_000


def inside_of_pose(decoded: Tensor) -> Tensor:
    """(N,) not clipped; the gripper is always at an end."""
    return (decoded[:, :6].abs() < 1).all(dim=1)


def test_every_cell_of_a_fitted_grid_lies_where_it_says() -> None:
    """Row-major, first coordinate slowest: decoded points increase with their own index only."""
    grids = fitted(normal_actions(20_000, 2), groups=(ActionGroup((1, 0), "identity", (3, 5)),))
    decoded = grids.decode(torch.arange(15)[:, None]).view(3, 5, 2)
    assert (decoded[1:, :, 1] > decoded[:-1, :, 1]).all() and (decoded[:, 1:, 1] == decoded[:, :-1, 1]).all()
    assert (decoded[:, 1:, 0] > decoded[:, :-1, 0]).all() and (decoded[1:, :, 0] == decoded[:-1, :, 0]).all()


def test_leading_shapes_and_strides_do_not_matter() -> None:
    grids = fitted(normal_actions(1000, 7))
    actions = normal_actions(24, 7, seed=2)
    cells = grids.encode(actions)
    assert torch.equal(grids.encode(actions.view(2, 3, 4, 7)), cells.view(2, 3, 4, 3))
    assert torch.equal(grids.encode(actions.T.contiguous().T), cells)
    assert torch.equal(grids.decode(cells.view(2, 12, 3)), grids.decode(cells).view(2, 12, 7))
    assert torch.equal(grids.encode(actions[0]), cells[0])
    assert grids.encode(actions[:0]).shape == (0, 3)


def test_binary_dims_are_closed_below_zero() -> None:
    grids = ActionGrids(GridSettings((ActionGroup((0,), "binary", (2,)),)), 1)
    values = torch.tensor([[-1.0], [-1e-6], [0.0], [0.3], [1.0]])
    assert grids.encode(values)[:, 0].tolist() == [0, 0, 1, 1, 1]
    assert grids.decode(torch.tensor([[0], [1]])).tolist() == [[-1.0], [1.0]]


# Storage


@pytest.mark.parametrize("point", ["mid", "cond_mean", "centroid"])
def test_json_alone_holds_the_whole_grid(point: str) -> None:
    actions = normal_actions(3000, 7, seed=3)
    grids = fitted(actions, np.array([0.2, 0, -0.1, 0, 0, 0, 0]), decode_point=point)
    copy = ActionGrids.from_dict(json.loads(json.dumps(grids.to_dict())), 7)
    other = normal_actions(3000, 7, seed=4)
    assert not torch.equal(ActionGrids(grids.settings, 7).encode(other), grids.encode(other))
    assert copy.settings == grids.settings
    assert torch.equal(copy.encode(other), grids.encode(other))
    assert torch.equal(copy.decode(copy.encode(other)), grids.decode(grids.encode(other)))
    assert copy.to_dict() == grids.to_dict()
    assert not grids.state_dict()


def test_a_grid_of_edges_alone_decodes_to_their_middles(bridge: dict[str, Any]) -> None:
    published = ActionGrids.from_published(bridge)
    edges = [row for group in range(3) for row in published.group_edges(group)]
    grids = ActionGrids.from_edges(edges, published.settings, 7)
    actions = normal_actions(3000, 7)
    cells = published.encode(actions)
    assert torch.equal(grids.encode(actions), cells)
    for point in ("mid", "cond_mean"):
        torch.testing.assert_close(grids.decode(cells, point), published.decode(cells, "mid"))


def test_edges_stay_float32_in_a_bfloat16_policy() -> None:
    grids = fitted(normal_actions(1000, 4))
    actions, edges = normal_actions(100, 4, seed=5), grids.edges.clone()
    cells = grids.encode(actions)
    module = torch.nn.Sequential(torch.nn.Linear(2, 2), grids).to(torch.bfloat16)
    assert next(module.parameters()).dtype == torch.bfloat16
    assert torch.equal(grids.edges, edges)
    assert torch.equal(grids.encode(actions), cells)
    assert grids.to("meta").edges.is_meta


def test_a_stored_grid_of_another_action_size_is_refused(bridge: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"--policy.action_groups: .* the action has 4"):
        ActionGrids.from_dict(ActionGrids.from_published(bridge).to_dict(), 4)
    with pytest.raises(ValueError, match="the action has 4 dims, but the grid was made for 7"):
        ActionGrids.from_published(bridge).encode(torch.zeros(2, 4))
    with pytest.raises(ValueError, match="the published grid lacks roll; it has x"):
        ActionGrids.from_published({key: gaussian for key, gaussian in bridge.items() if key != "roll"})
