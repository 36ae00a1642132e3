# pyright: reportAttributeAccessIssue=false
"""Perturbation axes: what they do to an episode, and what they leave alone."""

import itertools
import re
from dataclasses import fields
from pkgutil import resolve_name
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_bomb.bomb.board import BOARD, TRAY_CENTER_XY, TRAY_HALF_SIZE_XY
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.go import is_legal_position
from lerobot_bomb.bomb.layout import Layout
from lerobot_bomb.bomb.observation import CAMERAS
from lerobot_bomb.bomb.perturbations import AXES, NUISANCES
from lerobot_bomb.bomb.suites.place import FORMS, STONE
from lerobot_bomb.conditions import MAX_LEVEL
from lerobot_bomb.envs.photometric import Photometric
from lerobot_env_bomb.bomb.alternatives import alternatives
from lerobot_env_bomb.bomb.axes.dynamics import Dynamics
from lerobot_env_bomb.bomb.axes.language import Wording
from lerobot_env_bomb.bomb.axes.light import Light
from lerobot_env_bomb.bomb.axes.object import GREY, StoneLook
from lerobot_env_bomb.bomb.axes.stones import Stones
from lerobot_env_bomb.bomb.axes.table import TABLE_RGB, TableLook
from lerobot_env_bomb.bomb.axes.transform import Transform
from lerobot_env_bomb.bomb.model import compile_scene
from lerobot_env_bomb.bomb.perturb import PerturbedEpisode as Episode
from lerobot_env_bomb.bomb.perturb import sample_episode
from lerobot_env_bomb.bomb.robots import ROBOTS
from lerobot_env_bomb.bomb.scene import WORKSPACE_HIGH, WORKSPACE_LOW, Scene

SEEDS = st.integers(0, 2**31)
AXIS = st.sampled_from(list(AXES))
LEVEL = st.integers(1, MAX_LEVEL)
SOME_SEEDS = range(40)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene()


def episode(seed: int, condition: str = "none", **spec) -> Episode:
    return sample_episode(EpisodeSpec(seed=seed, perturbations=condition, **spec))


def drawn_of[T: Transform](kind: type[T], seed: int, condition: str, **spec) -> T:
    transform = episode(seed, condition, **spec).perturbation.of(kind)
    assert transform is not None
    return transform


def arranged(scene: Scene, seed: int, condition: str) -> Episode:
    """The episode, with its layout in the scene."""
    drawn = episode(seed, condition)
    scene.reset(drawn.layout, drawn.perturbation.model_edits)
    return drawn


def same(first: Layout, second: Layout, but: tuple[str, ...] = ()) -> bool:
    names = {field.name for field in fields(Layout)} - set(but)
    return all(np.array_equal(getattr(first, name), getattr(second, name)) for name in names)


def number_fields(model: Any) -> dict[str, np.ndarray]:
    values = {name: getattr(model, name) for name in dir(model) if not name.startswith("_")}
    arrays = {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
    return arrays | {"ambient": model.vis.headlight.ambient, "diffuse": model.vis.headlight.diffuse}


@settings(max_examples=60, deadline=None)
@given(SEEDS, st.dictionaries(AXIS, LEVEL, min_size=1), AXIS, LEVEL)
def test_an_axis_draws_the_same_whatever_the_others_do(
    seed: int, others: dict[str, int], axis: str, level: int
) -> None:
    condition = "+".join(f"{name}:{at}" for name, at in ({**others, axis: level}).items())
    together, alone = episode(seed, condition), episode(seed, f"{axis}:{level}")
    assert together.perturbation.transforms[axis] == alone.perturbation.transforms[axis]
    assert together.perturbation.levels == {**others, axis: level}
    assert episode(seed, condition).perturbation == together.perturbation


@settings(max_examples=60, deadline=None)
@given(SEEDS, AXIS, LEVEL)
def test_a_pair_differs_only_in_what_its_axis_names(seed: int, axis: str, level: int) -> None:
    nominal, perturbed = episode(seed), episode(seed, f"{axis}:{level}")
    assert (perturbed.target, perturbed.color) == (nominal.target, nominal.color)
    assert (perturbed.instruction == nominal.instruction) == (axis != "language")
    may_change = {
        "stones": ("stone_xy", "stone_is_white", "stone_in_play"),
        "start": ("stone_xy", "gripper_xyz"),
        "object": ("stone_radius_m", "stone_height_m"),
    }.get(axis, ())
    assert same(nominal.layout, perturbed.layout, but=may_change)
    assert same(nominal.layout, perturbed.layout) == ("scene" not in AXES[axis].changes)
    if axis == "stones":
        np.testing.assert_array_equal(perturbed.layout.stone_xy[STONE], nominal.layout.stone_xy[STONE])


@settings(max_examples=40, deadline=None)
@given(SEEDS, AXIS, st.tuples(st.integers(0, 5), st.integers(0, 5)).map(sorted))
def test_a_range_draws_one_of_its_levels_and_then_is_that_level(
    seed: int, axis: str, levels: list[int]
) -> None:
    drawn = episode(seed, f"{axis}:{levels[0]}-{levels[1]}")
    level = drawn.perturbation.levels.get(axis, 0)
    assert levels[0] <= level <= levels[1]
    assert drawn.perturbation == episode(seed, f"{axis}:{level}").perturbation


def test_a_range_draws_all_its_levels_and_the_axes_of_all_draw_apart() -> None:
    levels = [episode(seed, "all:1-5").perturbation.levels for seed in range(60)]
    assert {at for drawn in levels for at in drawn.values()} == {1, 2, 3, 4, 5}
    assert all(len(set(drawn.values())) > 1 for drawn in levels[:10])
    assert set(levels[0]) == set(NUISANCES)


def test_a_nominal_reset_undoes_every_edit(scene: Scene) -> None:
    fresh = {name: values.copy() for name, values in number_fields(compile_scene(ROBOTS["scara"])).items()}
    changed = set()
    for axis in AXES:
        arranged(scene, 1, f"{axis}:5")
        now = number_fields(scene.model)
        changed |= {name for name, values in fresh.items() if not np.array_equal(now[name], values)}
    arranged(scene, 1, "none")
    nominal = Scene()
    arranged(nominal, 1, "none")
    expected, now = number_fields(nominal.model), number_fields(scene.model)
    assert {name for name in expected if not np.array_equal(now[name], expected[name])} == set()
    assert {"cam_fovy", "light_dir", "mat_rgba", "geom_size", "body_mass", "ambient"} <= changed


def test_magnitudes_reach_the_floors_at_level_5(scene: Scene) -> None:
    lights = [drawn_of(Light, seed, "all:5").factor for seed in range(100)]
    assert max(lights) / min(lights) >= 4 - 1e-9
    dynamics = [drawn_of(Dynamics, seed, "all:5") for seed in range(100)]
    assert {drawn.mass_factor for drawn in dynamics} == {0.5, 2.0}
    assert all(drawn.latency >= 1 for drawn in dynamics)
    nominal = scene.model.camera(CAMERAS[0]).fovy[0]
    fovs = set()
    for seed in SOME_SEEDS:
        arranged(scene, seed, "none")
        looks = -scene.data.camera(CAMERAS[0]).xmat.reshape(3, 3)[:, 2].copy()
        arranged(scene, seed, "camera:5")
        turned = -scene.data.camera(CAMERAS[0]).xmat.reshape(3, 3)[:, 2]
        assert np.degrees(np.arccos(looks @ turned)) >= 15
        fovs.add(round(scene.model.camera(CAMERAS[0]).fovy[0] / nominal, 6))
        before, after = episode(seed).layout, episode(seed, "start:5").layout
        assert np.linalg.norm(after.stone_xy[STONE] - before.stone_xy[STONE]) >= 0.080
        assert np.linalg.norm(after.gripper_xyz - before.gripper_xyz) >= 0.080
    assert fovs == {0.8, 1.2}


@settings(max_examples=60, deadline=None)
@given(SEEDS, LEVEL)
def test_board_tray_and_stone_stay_in_the_image(scene: Scene, seed: int, level: int) -> None:
    drawn = arranged(scene, seed, f"camera:{level}+start:{level}")
    camera = scene.data.camera(CAMERAS[0])
    signs = np.array([(x, y) for x in (-1, 1) for y in (-1, 1)])
    corners = [signs * BOARD.half_size_m, TRAY_CENTER_XY + signs * np.array(TRAY_HALF_SIZE_XY)]
    xy = np.concatenate([*corners, drawn.layout.stone_xy[STONE][None]])
    xyz = np.column_stack([xy, np.full(len(xy), BOARD.thickness_m)])
    x, y, back = camera.xmat.reshape(3, 3).T @ (xyz - camera.xpos).T
    slope = np.tan(np.radians(scene.model.camera(CAMERAS[0]).fovy[0]) / 2)
    assert (abs(x) < -back * slope).all() and (abs(y) < -back * slope).all()


def seen(scene: Scene, camera: str, layout: Layout) -> float:
    """Share of the stone to be moved that a camera sees, by rays to points of its upper side."""
    import mujoco

    model, data = scene.model, scene.data
    pose, visual = data.camera(camera), model.geom("stone_0_visual").id
    slope = np.tan(np.radians(model.camera(camera).fovy[0]) / 2)
    drawn_groups = np.array([1, 1, 1, 0, 0, 0], np.uint8)
    hits = []
    for angle_rad in np.linspace(0, 2 * np.pi, 12, endpoint=False):
        offset = 0.6 * layout.stone_radius_m * np.array([np.cos(angle_rad), np.sin(angle_rad), 0.2])
        ray = data.body("stone_0").xpos + offset - pose.xpos
        x, y, back = pose.xmat.reshape(3, 3).T @ ray
        found = np.array([-1], np.int32)
        mujoco.mj_ray(model, data, pose.xpos, ray, drawn_groups, 1, -1, found)
        hits.append(found[0] == visual and max(abs(x), abs(y)) < -back * slope)
    return float(np.mean(hits))


@pytest.mark.parametrize(
    "condition", ["none", "start:3", "start:5", "camera:5", "stones:5", "all:3", "all:5"]
)
def test_a_camera_sees_the_stone_at_the_start(scene: Scene, condition: str) -> None:
    shares = []
    for seed in SOME_SEEDS:
        layout = arranged(scene, seed, condition).layout
        shares.append(max(seen(scene, camera, layout) for camera in CAMERAS))
    assert min(shares) > (0 if condition == "all:5" else 0.5)
    assert np.mean(np.array(shares) >= 0.5) >= 0.95


@settings(max_examples=60, deadline=None)
@given(SEEDS, LEVEL)
def test_a_perturbed_start_is_on_the_tray_and_in_the_workspace(seed: int, level: int) -> None:
    layout = episode(seed, f"start:{level}+object:{level}").layout
    to_edge = np.array(TRAY_HALF_SIZE_XY) - abs(layout.stone_xy[STONE] - np.array(TRAY_CENTER_XY))
    assert (to_edge >= layout.stone_radius_m).all()
    assert (layout.gripper_xyz >= WORKSPACE_LOW).all() and (layout.gripper_xyz <= WORKSPACE_HIGH).all()


@settings(max_examples=60, deadline=None)
@given(SEEDS, LEVEL)
def test_more_stones_keep_the_opening_and_the_move_legal(seed: int, level: int) -> None:
    nominal, drawn = episode(seed), episode(seed, f"stones:{level}")
    stones = drawn_of(Stones, seed, f"stones:{level}")
    assert len(stones.extra) == (1, 1, 2, 2, 3)[level - 1]
    before, after = nominal.layout, drawn.layout
    assert after.stone_in_play.sum() == before.stone_in_play.sum() + len(stones.extra)
    on_board = np.flatnonzero(after.stone_in_play)[1:]
    intersections = [BOARD.nearest_intersection(after.stone_xy[i]) for i in on_board]
    colors = ["white" if after.stone_is_white[i] else "black" for i in on_board]
    position = dict(zip(intersections, colors, strict=True))
    assert len(position) == len(intersections) and is_legal_position(position)
    assert drawn.allows(position)
    offsets = [
        after.stone_xy[i] - BOARD.intersection_xy(*intersection)
        for i, intersection in zip(on_board, intersections, strict=True)
    ]
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), stones.shift_m)
    kept = np.flatnonzero(before.stone_in_play)[1:]
    assert [BOARD.nearest_intersection(before.stone_xy[i]) for i in kept] == intersections[: len(kept)]


@pytest.mark.parametrize("seed", range(4))
def test_stones_of_any_size_and_mass_rest_where_they_are_put(scene: Scene, seed: int) -> None:
    drawn = arranged(scene, seed, "object:5+dynamics:5+stones:5")
    scene.move(drawn.layout.gripper_xyz, open_fingers=True, num_substeps=100)
    moved = scene.measure().stone_xyz - np.column_stack(
        [drawn.layout.stone_xy, np.full(len(drawn.layout.stone_xy), drawn.layout.rest_height_m)]
    )
    assert abs(moved[drawn.layout.stone_in_play]).max() < 1e-4


def test_mass_and_friction_change_as_if_compiled_so(scene: Scene) -> None:
    nominal = compile_scene(ROBOTS["scara"])
    stone = nominal.body("stone_3").id
    factors = set()
    for seed in range(20):
        dynamics = arranged(scene, seed, "dynamics:5").perturbation.of(Dynamics)
        assert dynamics is not None
        model = scene.model
        factors.add((dynamics.mass_factor, round(dynamics.friction_factor, 3)))
        assert model.body_mass[stone] == pytest.approx(0.006 * dynamics.mass_factor)
        np.testing.assert_allclose(model.geom("stone_3").friction[0], dynamics.friction_factor)
        np.testing.assert_array_equal(model.geom("left_pad").friction, nominal.geom("left_pad").friction)
        np.testing.assert_array_equal(model.body_mass[model.body("hand").id], nominal.body("hand").mass)
        rows = {"body_mass": stone, "body_inertia": stone, "body_subtreemass": stone}
        inverse_rows = {
            "body_invweight0": stone,
            "dof_invweight0": model.body("stone_3").dofadr[0] + np.arange(6),
        }
        for name, row in (rows | inverse_rows).items():
            ratio = getattr(model, name)[row] / getattr(nominal, name)[row]
            np.testing.assert_allclose(ratio ** (-1 if name in inverse_rows else 1), dynamics.mass_factor)
    assert factors == {(m, f) for m in (0.5, 2.0) for f in (0.714, 1.4)}


def test_the_colours_of_the_table_are_split_and_black_and_white_keep_their_sides() -> None:
    assert len(TABLE_RGB) == 8
    drawn = {
        split: {drawn_of(TableLook, seed, "table:5", split=split).table_rgb for seed in range(200)}
        for split in ("train", "heldout")
    }
    train, heldout = drawn.values()
    assert train == set(TABLE_RGB) and len(heldout) == 2 and not train & heldout
    look = drawn_of(StoneLook, 0, "object:5")
    model = compile_scene(ROBOTS["scara"])
    model.geom("stone_0_visual").rgba[:3] = 0.06
    model.geom("stone_1_visual").rgba[:3] = 0.96
    look.edit_model(model)
    black, white = (model.geom(f"stone_{i}_visual").rgba[0] for i in (0, 1))
    assert 0.06 < black < GREY < white < 0.96 and white - black > 0.4


def test_a_sensor_scales_colours_and_adds_noise_that_differs_from_image_to_image() -> None:
    grey = np.full((64, 64, 3), 100, np.uint8)
    sensor = Photometric(gains=(1.2, 1.0, 0.5), noise=4.0, first=7)
    first, second = sensor(grey, 0).astype(float), sensor(grey, 1).astype(float)
    np.testing.assert_allclose(first.mean((0, 1)), [120, 100, 50], atol=1)
    np.testing.assert_allclose(first.std((0, 1)), 4, rtol=0.1)
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) > 0.9  # the colours
    noise = [(image - image.mean((0, 1))).ravel() for image in (first, second)]
    assert abs(np.corrcoef(*noise)[0, 1]) < 0.05
    np.testing.assert_array_equal(sensor(grey, 1), second)
    bright = Photometric(gains=(1.4, 1.4, 1.4), noise=0.0, first=0)(np.full((2, 2, 3), 255, np.uint8), 0)
    dark = Photometric(gains=(1.0, 1.0, 1.0), noise=20.0, first=0)(np.zeros((64, 64, 3), np.uint8), 0)
    assert bright.min() == 255 and dark.max() < 128


@pytest.mark.parametrize(
    ("form", "which", "instruction"),
    [
        (1, 0, "Please place a white stone on the Go board at row 1, column 3."),
        (2, 0, "In column 3, row 1 of the grid: one white stone, please."),
        (3, 0, "Not at row 4, column 0: place a white stone at row 1, column 3."),
        (4, 0, "Counting rows and columns from 1, place a white stone at row 2, column 4."),
        (4, 1, "With row 0 at the near edge of the board, place a white stone at row 3, column 3."),
        (
            4,
            2,
            "With rows counted from 1 at the near edge and columns from 0, place a white stone at row 4, "
            "column 3.",
        ),
        (
            5,
            0,
            "Columns are A to E from left to right, rows 1 to 5 from the near edge. Leave A1 alone and place "
            "a white stone at D4.",
        ),
        (
            5,
            1,
            "If rows are 1 to 5 from the far edge and columns A to E from the left, a white stone is missing "
            "at D2, not at A5. Put it there.",
        ),
    ],
)
def test_instructions_mean_the_target_in_the_convention_they_state(
    form: int, which: int, instruction: str
) -> None:
    meant = episode(0, target=(1, 3), color="white")
    assert Wording(FORMS[form - 1][which], other=(4, 0)).reword(meant.instruction, meant) == instruction


def test_every_form_occurs_and_never_names_the_target_as_the_other_place() -> None:
    used = set()
    for seed, form in itertools.product(range(60), range(1, 6)):
        wording = drawn_of(Wording, seed, f"language:{form}")
        used.add(wording.template)
        assert wording.other != episode(seed).target
    assert used == {template for form in FORMS for template in form}


def test_every_axis_names_its_transform() -> None:
    kinds = [resolve_name(axis.transform) for axis in AXES.values()]
    assert len(set(kinds)) == len(AXES) and all(issubclass(kind, Transform) for kind in kinds)


@pytest.mark.parametrize("level", [3, 5])
def test_alternatives_never_forbid_what_they_ask(level: int) -> None:
    episodes = [episode(seed, f"language:{level}") for seed in range(200)]
    drawn = [(drawn_of(Wording, each.spec.seed, f"language:{level}"), each) for each in episodes]
    named = [(wording, target) for wording, each in drawn for _, target in alternatives(each).values()]
    assert len(named) == 600
    assert all(target != wording.other for wording, target in named)


def test_alternatives_of_a_named_stone_change_its_place() -> None:
    for seed in range(20):
        drawn = sample_episode(EpisodeSpec(seed, "object"))
        others = alternatives(drawn)
        assert [*others] == ["row", "column"]
        for instruction, (row, column) in others.values():
            assert drawn.turns[0].words["stone"] in instruction
            assert {str(row), str(column)} == set(re.findall(r"\d", instruction))
