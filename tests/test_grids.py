"""Action grids: SpatialVLA's published ones, fitted ones, and what is decoded from them."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import zarr
from hypothesis import given
from hypothesis import strategies as st
from pusht_cases import ZARR
from torch import Tensor

from lerobot_bomb.actions.grid_edges import MIN_WIDTH, cut, from_polar, gaussian_cut, to_polar
from lerobot_bomb.actions.grid_fit import normalised, normalised_rest
from lerobot_bomb.actions.grid_settings import ActionGroup, GridSettings, default_groups
from lerobot_bomb.actions.grids import ActionGrids

PI = math.pi
XYZ = ("x", "y", "z")


@pytest.fixture(scope="session")
def bridge(shared_data: Path) -> dict[str, Any]:
    return json.loads((shared_data / "spatialvla" / "gs_bridge.json").read_text())


def fitted(actions: Tensor | np.ndarray, rest: Any = None, **changes: Any) -> ActionGrids:
    """On normalised actions (N, D), with the default groups unless others are given."""
    num_dims = actions.shape[1]
    grids = ActionGrids(GridSettings(**{"groups": default_groups(num_dims), **changes}), num_dims)
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


# The published method


def test_edges_and_points_of_a_gaussian_by_hand() -> None:
    of = gaussian_cut(0.0, 0.3, -1.0, 1.0, 4)
    assert of.edges.tolist() == pytest.approx([-1, -0.202144, 0, 0.202144, 1], abs=1e-6)
    assert of.means.tolist() == pytest.approx([-0.379981, -0.097309, 0.097309, 0.379981], abs=1e-6)
    grids = ActionGrids(GridSettings((ActionGroup((0,), "identity", (4,)),), decode_point="mid"), 1)
    edges = {"edges": [of.edges.tolist()], "means": [of.means.tolist()], "gaussians": [[0.0, 0.3]]}
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


def test_a_least_sigma_widens_the_published_grid(bridge: dict[str, Any]) -> None:
    edges = ActionGrids.from_published(bridge, min_sigma=0.5).group_edges(1)[0]
    expected = gaussian_cut(bridge["roll"]["mu"], 0.5, -1, 1, 16).edges
    torch.testing.assert_close(edges, expected.float().double())
    assert edges[8] - edges[7] > 1.2 * ActionGrids.from_published(bridge).group_edges(1)[0].diff()[7]


def test_bridge_errors_of_both_decode_points(bridge: dict[str, Any]) -> None:
    """Independent draws with the data's means and deviations; the original decodes to the middle."""
    generator = torch.Generator().manual_seed(0)
    actions = torch.zeros(400_000, 7)
    for dim, key in enumerate(XYZ):
        of = bridge[key]
        actions[:, dim] = of["mu"] + of["sigma"] * torch.randn(len(actions), generator=generator)
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


# Fits


@given(
    mean=st.floats(-1, 1),
    std=st.floats(0, 20),
    num_bins=st.integers(2, 300),
    distribution=st.sampled_from(["gaussian", "uniform", "quantile"]),
)
def test_edges_increase_and_points_stay_in_their_bins(
    mean: float, std: float, num_bins: int, distribution: str
) -> None:
    noise = np.random.default_rng(0).normal(size=200)
    values = torch.from_numpy((mean + std * noise).clip(-1, 1))
    of = cut(values, -1, 1, num_bins, distribution, min_sigma=0.0)
    assert (of.edges[0], of.edges[-1]) == (-1, 1)
    assert of.edges.diff().min() >= MIN_WIDTH * (1 - 1e-9)
    assert ((of.means > of.edges[:-1]) & (of.means < of.edges[1:])).all()


def test_quantile_bins_hold_equal_shares() -> None:
    actions = normal_actions(64_000, 1).abs()
    grids = fitted(actions, distribution="quantile", groups=(ActionGroup((0,), "identity", (16,)),))
    counts = torch.bincount(grids.encode(actions)[:, 0], minlength=16)
    assert (counts - 4000).abs().max() <= 2


def test_points_of_fitted_bins_are_the_means_of_their_samples() -> None:
    actions = torch.tensor([[-0.9], [-0.7], [-0.1], [0.6]])
    groups = (ActionGroup((0,), "identity", (4,)),)
    grids = fitted(actions, distribution="uniform", groups=groups)
    decoded = grids.decode(torch.arange(4)[:, None])[:, 0].tolist()
    assert [decoded[0], decoded[1], decoded[3]] == pytest.approx([-0.8, -0.1, 0.6])
    gaussian = gaussian_cut(float(actions.mean()), float(actions.std(correction=0)), -1, 1, 4)
    assert 0 < decoded[2] < 0.25  # no sample: the Gaussian has more of its share near its mean
    assert gaussian.mean == pytest.approx(-0.275)


def test_centroids_are_the_means_of_their_cells() -> None:
    actions = torch.tensor([[0.3, 0.3], [0.5, 0.1], [-0.5, -0.2]])
    groups = (ActionGroup((0, 1), "identity", (2, 2)),)
    grids = fitted(actions, distribution="uniform", decode_point="centroid", groups=groups)
    assert grids.encode(actions)[:, 0].tolist() == [3, 3, 0]
    decoded = grids.decode(torch.arange(4)[:, None])
    assert decoded[[0, 3]].tolist() == [pytest.approx([-0.5, -0.2]), pytest.approx([0.4, 0.2])]
    assert torch.equal(decoded[1:3], grids.decode_group(0, torch.tensor([1, 2]), "cond_mean"))


def test_a_dimension_that_never_changes_comes_back() -> None:
    for constant in (-1.0, 0.37):
        actions = normal_actions(1000, 7)
        actions[:, [0, 1, 2, 4]] = constant  # a direction and a length that never change, too
        grids = fitted(actions)
        decoded = grids.decode(grids.encode(actions))
        assert (decoded[:, [0, 1, 2, 4]] - constant).abs().max() < 3e-4


def test_no_motion_is_exact() -> None:
    grids = fitted(normal_actions(5000, 7))
    still = torch.zeros(1, 7)
    assert grids.encode(still)[0, 0] == 0
    assert grids.decode(grids.encode(still))[0, :3].tolist() == [0, 0, 0]
    dead = grids.group_edges(0)[2]
    assert dead[:2].tolist() == pytest.approx([0, 0.02])
    directions = torch.nn.functional.normalize(torch.randn(500, 3), dim=1)
    for length, is_still in ((0.0199, True), (0.0202, False)):
        actions = torch.cat([length * directions, torch.zeros(500, 4)], dim=1)
        assert bool((grids.encode(actions)[:, 0] == 0).all()) == is_still
        assert bool((grids.decode(grids.encode(actions))[:, :3] == 0).all()) == is_still
    first_bins = torch.arange(0, 4096, 8)  # whatever their direction
    assert (grids.decode_group(0, first_bins) == 0).all()
    shipped = fitted(normal_actions(5000, 7), zero_radius_bin=False)
    assert shipped.decode(shipped.encode(still))[0, :3].norm() > 0.01


def test_no_motion_is_where_the_normaliser_puts_it() -> None:
    """Bounds that are not symmetric: an action of 0 is not 0 once normalised."""
    low, high = np.array([-0.70, -0.18, -0.75, -1.0]), np.array([0.08, 0.13, 0.75, 1.0])
    actions = np.random.default_rng(0).uniform(low, high, size=(5000, 4))
    rest = normalised_rest(low, high)
    assert rest[:3] == pytest.approx([0.794872, 0.161290, 0], abs=1e-6)
    grids = fitted(normalised(actions, low, high), rest)
    still = torch.from_numpy(normalised(np.zeros((1, 4)), low, high))
    decoded = grids.decode(grids.encode(still)).double().numpy()
    physical = (decoded + 1) / 2 * (high - low) + low
    assert grids.encode(still)[0, 0] == 0
    assert np.abs(physical[0, :3]).max() < 1e-7
    # around the normalised 0, "no motion" would be one of 0.31 to -x
    around_zero = fitted(normalised(actions, low, high)).decode(torch.zeros(1, 2, dtype=torch.int64))
    assert (around_zero[0, 0].item() + 1) / 2 * (0.08 + 0.70) - 0.70 == pytest.approx(-0.31)


def test_an_action_that_is_never_zero_has_its_centre_for_rest() -> None:
    assert normalised_rest(np.array([0.2, -1.0]), np.array([0.6, 1.0])).tolist() == [0.0, 0.0]


def test_a_direction_near_the_cut_of_phi_keeps_its_resolution() -> None:
    """Motions to -x, phi around pi, are told apart as well as motions to +x; not so if phi is cut there."""
    errors = {}
    for phi_fit, way in (("wrapped", 1), ("wrapped", -1), ("linear", -1)):
        actions = 0.1 * torch.randn(20_000, 7, generator=torch.Generator().manual_seed(0))
        actions[:, 0] += 0.6
        actions[:, :2] *= way
        grids = fitted(actions, phi_fit=phi_fit)
        decoded = grids.decode(grids.encode(actions))
        turn = to_polar(decoded[:, :3])[:, 1] - to_polar(actions[:, :3])[:, 1]
        errors[phi_fit, way] = ((turn + PI) % (2 * PI) - PI).abs().mean().item()
    assert errors["wrapped", 1] < 0.0085  # radians
    assert errors["wrapped", -1] == pytest.approx(errors["wrapped", 1], rel=0.01)
    assert errors["linear", -1] > 6 * errors["wrapped", -1]


@pytest.mark.parametrize("middle", [0.0, 2.0, PI, -3.0])
def test_every_direction_is_in_a_bin_of_phi_that_holds_it(middle: float) -> None:
    grids = fitted(ring(middle + 0.5 * torch.randn(5000, generator=torch.Generator().manual_seed(0))))
    edges = grids.group_edges(0)[1]
    assert ((edges[0] + edges[-1]) / 2 - middle + PI).item() % (2 * PI) == pytest.approx(PI, abs=0.05)
    angles = torch.linspace(-PI, PI, 1001)
    bins = grids.encode(ring(angles))[:, 0] // 8 % 32
    turns = angles[:, None].double() + 2 * PI * torch.tensor([-1, 0, 1])
    low, high = edges[bins][:, None] - 1e-5, edges[bins + 1][:, None] + 1e-5
    assert ((turns >= low) & (turns <= high)).any(dim=1).all()


def ring(angles: Tensor) -> Tensor:
    """(N,) radians -> actions (N, 7) half way out in these directions of the plane."""
    actions = torch.zeros(len(angles), 7)
    actions[:, 0], actions[:, 1] = 0.5 * angles.cos(), 0.5 * angles.sin()
    return actions


def test_real_pusht_actions_come_back_nearer_than_with_midpoints(shared_data: Path) -> None:
    group = zarr.open_group(shared_data / ZARR, mode="r")
    pixels = np.asarray(group["data/action"])  # type: ignore[index]
    low, high = np.quantile(pixels, [0.01, 0.99], axis=0)
    actions = torch.from_numpy(normalised(pixels, low, high)).clamp(-1, 1).float()
    grids = fitted(actions)
    middle, default, centroid = (
        error(grids, actions, point).mean() for point in ("mid", "cond_mean", "centroid")
    )
    assert centroid < default <= middle < 0.016


# Storage


@pytest.mark.parametrize("point", ["mid", "cond_mean", "centroid"])
def test_json_and_state_dict_hold_the_whole_grid(point: str) -> None:
    actions = normal_actions(3000, 7, seed=3)
    grids = fitted(actions, np.array([0.2, 0, -0.1, 0, 0, 0, 0]), decode_point=point)
    copy = ActionGrids.from_dict(json.loads(json.dumps(grids.to_dict())), 7)
    loaded = ActionGrids(grids.settings, 7)
    other = normal_actions(3000, 7, seed=4)
    assert not torch.equal(loaded.encode(other), grids.encode(other))
    loaded.load_state_dict(grids.state_dict())
    for same in (copy, loaded):
        assert same.settings == grids.settings
        assert torch.equal(same.encode(other), grids.encode(other))
        assert torch.equal(same.decode(same.encode(other)), grids.decode(grids.encode(other)))
        assert same.to_dict() == grids.to_dict()


def test_a_checkpoint_can_be_decoded_otherwise() -> None:
    actions = normal_actions(3000, 7)
    grids = fitted(actions)
    other = ActionGrids(GridSettings(default_groups(7), decode_point="centroid"), 7)
    other.load_state_dict(grids.state_dict())
    grids.decode_point = "centroid"
    assert torch.equal(other.decode(other.encode(actions)), grids.decode(grids.encode(actions)))


def test_edges_stay_float32_in_a_bfloat16_policy() -> None:
    grids = fitted(normal_actions(1000, 4))
    actions, edges = normal_actions(100, 4, seed=5), grids.edges.clone()
    cells = grids.encode(actions)
    module = torch.nn.Sequential(torch.nn.Linear(2, 2), grids).to(torch.bfloat16)
    assert next(module.parameters()).dtype == torch.bfloat16
    assert torch.equal(grids.edges, edges)
    assert torch.equal(grids.encode(actions), cells)
    assert grids.to("meta").edges.is_meta


# Bad input


def test_actions_out_of_range_are_clipped_and_counted() -> None:
    actions = normal_actions(100, 4) * 0.9
    actions[3, 0], actions[3, 1], actions[7, 3] = 1.5, -2.0, -1.1
    grids, clipped = ActionGrids(GridSettings(default_groups(4)), 4), fitted(actions.clamp(-1, 1))
    assert grids.fit(actions) == 2
    assert torch.equal(grids.edges, clipped.edges) and torch.equal(grids.centroids, clipped.centroids)
    assert torch.equal(grids.encode(actions), grids.encode(actions.clamp(-1, 1)))


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (torch.zeros(0, 4), r"on actions \(N, D\), not on shape \(0, 4\)"),
        (torch.zeros(4), r"on actions \(N, D\), not on shape \(4,\)"),
        (torch.zeros(5, 7), "the action has 7 dims, but the grid was made for 4"),
        (torch.tensor([[0.0] * 4, [0.0, math.nan, 0.0, 0.0]]), "1 of 2 actions are not finite, .* index 1"),
        (torch.full((3, 4), math.inf), "3 of 3 actions are not finite, the first at index 0"),
    ],
)
def test_actions_that_cannot_be_fitted(actions: Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ActionGrids(GridSettings(default_groups(4)), 4).fit(actions)


@pytest.mark.parametrize(
    ("groups", "message"),
    [
        ([((0, 1, 2), "polar", (4, 4, 4))], r"--policy.action_groups: .* dims \[0, 1, 2\]; the action has 4"),
        ([((0, 1), "identity", (4, 4)), ((1, 2, 3), "identity", (4, 4, 4))], r"dims \[0, 1, 1, 2, 3\]"),
        ([((0, 1), "polar", (4, 4))], "polar has 3 of each, binary 1"),
        ([((0, 1), "identity", (4,))], "as many bins as dims"),
        ([((0,), "binary", (3,))], r"a binary group has bins \[2\]"),
        ([((0,), "identity", (1,))], r"bins \[1\] must each be in 2..4096"),
        ([((0,), "log", (4,))], "transform='log' is unknown; choose one of: polar, identity, binary"),
    ],
)
def test_groups_that_do_not_fit(groups: list[tuple], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ActionGrids(GridSettings(tuple(ActionGroup(*group) for group in groups)), 4)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"distribution": "cauchy"}, "--policy.grid_distribution='cauchy' is unknown"),
        ({"decode_point": "mode"}, "--policy.decode_point='mode' is unknown"),
        ({"phi_fit": "circular"}, "phi_fit='circular' is unknown"),
        ({"min_sigma": -1.0}, "--policy.grid_min_sigma=-1.0 must be"),
        ({"rho_dead": 0.0}, "rho_dead=0.0 must be in"),
    ],
)
def test_settings_that_do_not_exist(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        GridSettings(default_groups(7), **changes)


def test_a_stored_grid_of_another_action_size_is_refused(bridge: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"--policy.action_groups: .* the action has 4"):
        ActionGrids.from_dict(ActionGrids.from_published(bridge).to_dict(), 4)
    with pytest.raises(ValueError, match="the action has 4 dims, but the grid was made for 7"):
        ActionGrids.from_published(bridge).encode(torch.zeros(2, 4))
    with pytest.raises(ValueError, match="the published grid lacks roll; it has x"):
        ActionGrids.from_published({key: of for key, of in bridge.items() if key != "roll"})


@pytest.mark.parametrize(
    ("num_dims", "dims"),
    [
        (2, [(0, 1)]),
        (4, [(0, 1, 2), (3,)]),
        (5, [(0, 1, 2), (3, 4)]),
        (7, [(0, 1, 2), (3, 4, 5), (6,)]),
        (14, [(0, 1, 2), (3, 4, 5), (6,), (7, 8, 9), (10, 11, 12), (13,)]),
    ],
)
def test_default_groups(num_dims: int, dims: list[tuple[int, ...]]) -> None:
    groups = default_groups(num_dims)
    assert [group.dims for group in groups] == dims
    is_pose = num_dims in (4, 7)
    assert [group.transform == "polar" for group in groups] == [is_pose, *[False] * (len(dims) - 1)]
    assert ActionGrids(GridSettings(groups), num_dims).num_dims == num_dims
