"""Action grids that are fitted: on which samples, where exactly, and on what not."""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import zarr
from grid_cases import error, fitted, normal_actions
from hypothesis import given
from hypothesis import strategies as st
from pusht_cases import ZARR
from torch import Tensor

from lerobot_bomb.actions.grid_edges import MIN_WIDTH, cut, gaussian_cut, to_polar
from lerobot_bomb.actions.grid_fit import dead_radius, fit_cuts, normalised, normalised_rest
from lerobot_bomb.actions.grid_report import clipping_text, rest_text
from lerobot_bomb.actions.grid_settings import ActionGroup, GridSettings, default_groups
from lerobot_bomb.actions.grids import ActionGrids

PI = math.pi


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
    fitted_cut = cut(values, -1, 1, num_bins, distribution, min_sigma=0.0)
    assert (fitted_cut.edges[0], fitted_cut.edges[-1]) == (-1, 1)
    assert fitted_cut.edges.diff().min() >= MIN_WIDTH * (1 - 1e-9)
    assert ((fitted_cut.means > fitted_cut.edges[:-1]) & (fitted_cut.means < fitted_cut.edges[1:])).all()


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
    grids = fitted(normal_actions(5000, 7), rho_dead=0.02)
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


# Bad input


def test_actions_out_of_range_are_clipped_and_counted() -> None:
    actions = normal_actions(100, 4) * 0.9
    actions[3, 0], actions[3, 1], actions[7, 3], actions[9, 2] = 1.5, -2.0, -1.1, 1.0005  # the last: a hair
    grids, clipped = ActionGrids(GridSettings(default_groups(4)), 4), fitted(actions.clamp(-1, 1))
    grids.fit(actions)
    text, is_much = clipping_text(actions.numpy(), ["x", "y", "z", "gripper"])
    assert text.startswith("2 of 100 actions are beyond the grid")
    assert text.endswith("x 1.0% by up to 0.5, y 1.0% by up to 1, gripper 1.0% by up to 0.1") and not is_much
    assert torch.equal(grids.edges, clipped.edges) and torch.equal(grids.centroids, clipped.centroids)
    assert torch.equal(grids.encode(actions), grids.encode(actions.clamp(-1, 1)))


def test_a_range_that_cuts_off_more_than_quantiles_do_is_named_with_the_remedy() -> None:
    actions = np.linspace(-1.2, 1, 100)[:, None]
    text, is_much = clipping_text(actions, ["x"])
    assert is_much and "ACTION: MIN_MAX clips nothing" in text
    assert clipping_text(actions.clip(-1, 1), ["x"]) == ("none of 100 actions is beyond the grid", False)


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
        ([((0, 1), "binary", (2, 2))], "polar has 3 of each, binary 1"),
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
        GridSettings(default_groups(7, layout="pose"), **changes)


# What an action is


POSE = ["x", "y", "z", "roll", "pitch", "yaw", "gripper"]
ARM = ["waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate", "gripper"]


@pytest.mark.parametrize(
    ("names", "layout", "num_dims"),
    [
        (POSE, None, 7),
        (["dx", "dy", "dz", "droll", "dpitch", "dyaw", "open_gripper"], None, 7),
        (["eef_pos_x", "eef_pos_y", "eef_pos_z", "a", "b", "c", "gripper.pos"], None, 7),
        (ARM, "pose", 7),
        (None, "pose", 7),
        (["dx", "dy", "dz", "gripper"], None, 4),
        (None, None, 4),
    ],
)
def test_a_pose_has_a_direction_a_length_and_a_gripper(
    names: list[str] | None, layout: str | None, num_dims: int
) -> None:
    groups = default_groups(num_dims, names, layout)
    assert (groups[0].dims, groups[0].transform) == ((0, 1, 2), "polar")
    assert [group.transform for group in groups[1:]] == (
        ["identity", "binary"] if num_dims == 7 else ["identity"]
    )


@pytest.mark.parametrize(
    ("names", "layout", "num_dims"),
    [
        ([f"joint_{i}" for i in range(7)], None, 7),
        (ARM, None, 7),
        (POSE, "joints", 7),
        (["base", "shoulder", "elbow", "gripper"], None, 4),
        (None, None, 6),
        (None, None, 14),
    ],
)
def test_no_joint_is_binary_and_each_comes_back_to_a_hundredth_of_its_range(
    names: list[str] | None, layout: str | None, num_dims: int
) -> None:
    groups = default_groups(num_dims, names, layout)
    assert [group.dims for group in groups] == [(dim,) for dim in range(num_dims)]
    errors = joint_errors(groups, num_dims)
    assert errors.mean() < 0.0025 and errors.quantile(0.99) < 0.01  # of a range of 2


def test_three_joints_in_a_token_would_be_off_by_degrees() -> None:
    groups = [(0, 1, 2), (3, 4, 5), (6,)]
    errors = joint_errors(tuple(ActionGroup(dims, "identity", (16,) * len(dims)) for dims in groups), 7)
    assert errors.mean() == pytest.approx(0.04, abs=5e-4)


def joint_errors(groups: tuple[ActionGroup, ...], num_dims: int) -> Tensor:
    """Return the errors of joints that swing, each at a pace of its own: (N, D)."""
    seconds = torch.linspace(0, 20, 2000, dtype=torch.float64)[:, None]
    actions = (seconds * (0.5 + 0.1 * torch.arange(num_dims))).sin()
    grids = fitted(actions, groups=groups)
    return (grids.decode(grids.encode(actions)) - actions).abs()


@pytest.mark.parametrize(
    "names", [None, ["0", "1", "2", "3", "4", "5", "6"], [f"motor_{i}" for i in range(7)], [*POSE[:6], "w"]]
)
def test_seven_dims_that_nothing_tells_of_are_an_error_that_names_both_ways_out(
    names: list[str] | None,
) -> None:
    with pytest.raises(ValueError, match=r"action_layout is not given.*action_layout=pose.*=joints"):
        default_groups(7, names)


def test_a_pose_has_four_or_seven_dims() -> None:
    with pytest.raises(ValueError, match=r"--policy.action_layout=pose is x, y, z, .* has 6 dims"):
        default_groups(6, layout="pose")


def test_two_dims_share_a_token() -> None:
    assert default_groups(2) == (ActionGroup((0, 1), "identity", (64, 64)),)


# Frames that are not like the others


def with_glitches(size: float, num_frames: int = 400) -> np.ndarray:
    """Motions of about 16 mm, but for two frames; in metres."""
    actions = np.random.default_rng(0).normal(0, 0.01, (num_frames, 4))
    if size:
        actions[100, :3], actions[300, :3] = size, -size
    return actions


def fit_of(actions: np.ndarray, **changes: Any) -> tuple[ActionGrids, np.ndarray, float]:
    """A grid, what it is fitted on, and its mean error as a share of the mean motion, without glitches."""
    low, high = actions.min(axis=0), actions.max(axis=0)
    values = normalised(actions, low, high)
    grids = fitted(values, normalised_rest(low, high), **changes)
    decoded = grids.decode(grids.encode(torch.from_numpy(values))).numpy()
    errors = np.linalg.norm(((decoded - values) * (high - low) / 2)[:, :3], axis=1)
    others = np.delete(np.arange(len(actions)), [100, 300])
    return grids, values, errors[others].mean() / np.linalg.norm(actions[others, :3], axis=1).mean()


def test_two_glitches_in_400_frames_do_not_stop_the_others() -> None:
    clean = fit_of(with_glitches(0))[2]
    grids, values, error = fit_of(with_glitches(1.0))
    cells = grids.encode(torch.from_numpy(values))
    assert (cells[:, 0] == 0).sum() == 0
    assert clean < 0.12 and error < 0.31
    stopped, _, error = fit_of(with_glitches(1.0), rho_dead=0.02)
    assert (stopped.encode(torch.from_numpy(values))[:, 0] == 0).float().mean() > 0.7 and error > 0.6


def test_what_rests_is_still_rest_beside_motions_of_any_size() -> None:
    actions = with_glitches(1.0)
    actions[::2, :3] = 0
    actions[1::20, :3] = 1e-5  # a thousandth of a motion: noise
    grids, values, _ = fit_of(actions)
    is_still = grids.encode(torch.from_numpy(values))[:, 0] == 0
    assert is_still[::2].all() and is_still[1::20].all()
    assert is_still.float().mean() < 0.56


def test_still_motions_do_not_count_among_the_long_ones() -> None:
    lengths = torch.cat([torch.zeros(20), torch.arange(1.0, 21.0)])
    # 0.02 of the 19th of the 20 that move; of all 40 the 38th is 18
    assert dead_radius(lengths) == pytest.approx(0.38)
    assert dead_radius(torch.zeros(5)) == 0.02


@pytest.mark.parametrize("zero_radius_bin", [True, False])
def test_still_motions_have_no_direction(zero_radius_bin: bool) -> None:
    """Half of the motions go along y, the others rest; theta and phi of nothing would be 0."""
    actions = torch.zeros(40, 3, dtype=torch.float64)
    actions[20:, 1] = 0.5
    group = ActionGroup((0, 1, 2), "polar", (4, 4, 4))
    settings = GridSettings(groups=(group,), zero_radius_bin=zero_radius_bin, phi_fit="linear")
    theta, phi, rho = fit_cuts(actions, np.zeros(3), settings)
    assert (theta.mean, phi.mean) == pytest.approx((PI / 2, PI / 2))
    # lengths are cut where directions are not: they rest, too, where no bin is for that
    assert rho.mean == pytest.approx(0.5 if zero_radius_bin else 0.25)


def test_frames_so_far_off_that_no_bin_holds_the_others_are_named() -> None:
    message = (
        r"95% of the dataset's motions are shorter than 1/\d+ of the longest.* actions (100, 300|300, 100),"
    )
    with pytest.raises(ValueError, match=message):
        fit_of(with_glitches(10.0))


def test_the_report_says_what_is_decoded_to_rest() -> None:
    names = ["dx", "dy", "dz", "gripper"]
    clean, values, _ = fit_of(with_glitches(0))
    text, needs_remedy = rest_text(clean, values, names)
    assert text.startswith("dx, dy, dz: 0.0% of the actions are decoded to no motion (shorter than 0.0")
    assert text.endswith("0.0% of those that move") and not needs_remedy
    grids, values, _ = fit_of(with_glitches(1.0))
    text, needs_remedy = rest_text(grids, values, names)
    assert needs_remedy and "times as long as 95% of them" in text and "grid_distribution=quantile" in text
    old, values, _ = fit_of(with_glitches(1.0), rho_dead=0.02)
    text, needs_remedy = rest_text(old, values, names)
    assert needs_remedy and re.search(r"7\d.\d% of those that move. --policy.rho_dead=null", text)
    shipped, values, _ = fit_of(with_glitches(0), zero_radius_bin=False)
    assert rest_text(shipped, values, names) == ("", False)
