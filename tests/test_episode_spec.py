import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lerobot_bomb.bomb.board import BOARD, NUM_STONES
from lerobot_bomb.bomb.episode import EpisodeSpec, Stage
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.bomb.privileged_state import Goal, PrivilegedState
from lerobot_bomb.bomb.suite import specs_of_tasks
from lerobot_bomb.bomb.suites import SUITES
from lerobot_bomb.results.bomb import EpisodeResult


def test_row_0_is_far_and_columns_run_along_x() -> None:
    assert BOARD.intersection_xy(0, 0).tolist() == pytest.approx([-0.09, 0.09])
    assert BOARD.intersection_xy(4, 3).tolist() == pytest.approx([0.045, -0.09])


@given(st.integers(0, 4), st.integers(0, 4), st.floats(-0.0224, 0.0224), st.floats(-0.0224, 0.0224))
def test_nearest_intersection_inverts_intersection_xy(row: int, column: int, dx: float, dy: float) -> None:
    assert BOARD.nearest_intersection(BOARD.intersection_xy(row, column) + np.array((dx, dy))) == (
        row,
        column,
    )


def test_numbered_tasks_are_25_intersections_in_2_colours() -> None:
    specs = specs_of_tasks(EpisodeSpec(seed=7), range(50))
    assert (specs[0].target, specs[0].color) == ((0, 0), "black")
    assert (specs[38].target, specs[38].color) == ((2, 3), "white")
    assert len({(spec.target, spec.color) for spec in specs}) == 50
    assert {spec.seed for spec in specs} == {7}


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("suite", "plce", f"--env.task='plce' is unknown; choose one of: {', '.join(SUITES)}"),
        ("robot", "panda", "--env.robot='panda' is unknown; choose one of: scara"),
        ("control_mode", "joint", "--env.control_mode='joint' is unknown; choose one of: relative, absolute"),
        ("split", "test", "--env.split='test' is unknown; choose one of: all, train, heldout"),
        ("color", "red", "--env.color='red' is unknown; choose one of: black, white"),
        ("seed", -1, "--seed=-1 must lie in 0..4294967295"),
        (
            "fps",
            7,
            "--env.fps=7 does not divide the physics rate of 200 Hz; choose one of: 1, 2, 4, 5, 8, 10",
        ),
        ("fps", 0, "--env.fps=0 does not divide"),
        ("target", (5, 0), r"--env.target=\[5, 0\] is off the board; give \[row, column\], each in 0..4"),
        ("target", (0, -1), r"--env.target=\[0, -1\] is off the board"),
        ("target", (1, 2, 3), r"--env.target=\[1, 2, 3\] is off the board"),
        ("success_tolerance_mm", 0.0, "--env.success_tolerance_mm=0.0 must lie between 0 and"),
        ("success_tolerance_mm", 26.0, "--env.success_tolerance_mm=26.0 must lie between 0 and"),
    ],
)
def test_a_wrong_spec_names_the_flag_and_what_is_allowed(field: str, value: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        EpisodeSpec(**{"seed": 0, field: value})  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("task", [-1, 50])
def test_unknown_task_numbers_are_refused(task: int) -> None:
    with pytest.raises(ValueError, match=rf"--env.task_ids has {task}; 'place' has tasks 0..49"):
        specs_of_tasks(EpisodeSpec(seed=0), [task])


@pytest.mark.parametrize("size", [-256, 0, 31, 1025])
def test_absurd_image_sizes_are_refused(size: int) -> None:
    with pytest.raises(ValueError, match=rf"--env.image_size={size} must lie in 32..1024 pixels"):
        RenderOptions(image_size=size)


def test_unknown_render_presets_are_refused() -> None:
    with pytest.raises(ValueError, match=r"--env.render_preset='raytraced' is unknown; choose one of: fast"):
        RenderOptions(preset="raytraced")


@pytest.mark.parametrize("stones", [(3,), (3, 0)])
def test_privileged_state_survives_the_observation(stones: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    state = PrivilegedState(
        gripper_xyz=np.array([0.01, -0.02, 0.1]),
        finger_opening=0.026,
        goals=tuple(Goal(rng.normal(size=3), stone) for stone in stones),
        stone_xyz=rng.normal(size=(NUM_STONES, 3)),
        stone_is_white=rng.random(NUM_STONES) > 0.5,
        stone_in_play=rng.random(NUM_STONES) > 0.5,
        stage=Stage.GRASPED,
        stone_radius_m=0.011,
        max_opening_m=0.033,
        pending_motion_m=np.array([0.01, 0.0, -0.02]),
        pending_gripper=-1.0,
    )
    vector = state.to_vector()
    assert vector.shape == (PrivilegedState.dim(len(stones)),)
    back = PrivilegedState.from_vector(vector)
    assert (tuple(goal.stone for goal in back.goals), back.stage) == (stones, Stage.GRASPED)
    for goal, before in zip(back.goals, state.goals, strict=True):
        np.testing.assert_allclose(goal.xyz, before.xyz, rtol=1e-6)
    np.testing.assert_allclose(back.stone_xyz, state.stone_xyz, rtol=1e-6)
    np.testing.assert_array_equal(back.stone_is_white, state.stone_is_white)
    np.testing.assert_array_equal(back.stone_in_play, state.stone_in_play)
    assert back.finger_opening == pytest.approx(0.026)
    assert (back.stone_radius_m, back.max_opening_m) == pytest.approx((0.011, 0.033))
    np.testing.assert_allclose(back.pending_motion_m, state.pending_motion_m, rtol=1e-6)
    assert back.pending_gripper == -1.0


def test_privileged_state_refuses_another_size() -> None:
    with pytest.raises(ValueError, match=r"shape \(3,\), expected"):
        PrivilegedState.from_vector(np.zeros(3))


def test_a_result_is_one_line_of_json_with_its_seed() -> None:
    result = EpisodeResult(
        task_version="1.0",
        spec=EpisodeSpec(seed=5),
        instruction="Put it there.",
        task_id=0,
        target=(3, 4),
        color="black",
        steps=31,
        progress=1.0,
        is_success=False,
        is_success_bomb_v0=True,
        failure="imprecise",
        stage="placed",
        placement_error_mm=12.5,
        nearest_intersection=(3, 4),
        collateral_mm=0.0,
    )
    line = result.to_json()
    assert "\n" not in line
    row = json.loads(line)
    assert (row["spec"]["seed"], row["failure"], row["placement_error_mm"]) == (5, "imprecise", 12.5)
