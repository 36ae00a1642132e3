"""Pointing beside what is meant and what is done."""

import json
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from explain_cases import OPTIONS, SPEC, end_episodes_after
from pointing_cases import PLACES, POINTING
from policy_cases import save_checkpoint

from lerobot_bomb.bomb.board import BOARD, NUM_STONES
from lerobot_bomb.bomb.camera import PinholeCamera
from lerobot_bomb.bomb.expert import GRASP_DEPTH_M, SQUEEZE_M, expert_action
from lerobot_bomb.bomb.move import place_name
from lerobot_bomb.bomb.pointing import PointedAt
from lerobot_bomb.bomb.privileged_state import Goal, PrivilegedState
from lerobot_bomb.commands.main import main
from lerobot_bomb.envs.rollout import make_env
from lerobot_bomb.explain.episode import ExplainedMoment
from lerobot_bomb.explain.moment import Explanation
from lerobot_bomb.explain.pointing import MARKED_PX, PLACE_RGB, Mark, PointingCheck, marked
from lerobot_bomb.explain.snapshots import Snapshot
from lerobot_bomb.report.explained_pointing import mean_pointing, pointing_tables

REST_M = BOARD.thickness_m + BOARD.stone_height_m / 2
MEANT_XY = (0.045, 0.045)  # row 1, column 3
WRONG_XY = (0.045, 0.0)  # row 2, column 3
TRAY_XY = (0.170, 0.030)


def true_state(*, held: bool, gripper_xyz: tuple[float, float, float] = (0.0, 0.0, 0.06)) -> PrivilegedState:
    """A stone in the fingers or in the tray, which is to go to row 1, column 3."""
    x, y, z = gripper_xyz
    stone_xyz = np.zeros((NUM_STONES, 3))
    stone_xyz[0] = (x, y, z + GRASP_DEPTH_M) if held else (*TRAY_XY, REST_M)
    is_first = np.arange(NUM_STONES) == 0
    return PrivilegedState(
        gripper_xyz=np.array(gripper_xyz),
        finger_opening=2 * BOARD.stone_radius_m - SQUEEZE_M if held else 0.044,
        goals=(Goal(np.array([*MEANT_XY, REST_M]), 0),),
        stone_xyz=stone_xyz,
        stone_is_white=~is_first,
        stone_in_play=is_first,
    )


def check(
    state: PrivilegedState,
    action: np.ndarray,
    place_xy: tuple[float, float] = MEANT_XY,
    stone_xy: tuple[float, float] | None = None,
    **said: Any,
) -> PointingCheck:
    stone = state.stone_xyz[0, :2] if stone_xy is None else np.array(stone_xy)
    return PointingCheck(PointedAt(np.array(place_xy), stone, **said), state, action)


def towards(state: PrivilegedState, place_xy: tuple[float, float]) -> np.ndarray:
    """The expert's action for another place."""
    return expert_action(replace(state, goals=(Goal(np.array([*place_xy, REST_M]), 0),)))


STILL = np.zeros(4, np.float32)
CARRYING = true_state(held=True)


@pytest.mark.parametrize(
    ("place_xy", "action", "answer", "names"),
    [
        (
            MEANT_XY,
            towards(CARRYING, MEANT_XY),
            "row 1, column 3; all as is meant",
            ("right place", "right stone", "goes there"),
        ),
        (
            MEANT_XY,
            STILL,
            "row 1, column 3; all as is meant; the next action does not go there: it knows and does not act",
            ("right place", "right stone", "does not go there"),
        ),
        (
            MEANT_XY,
            towards(CARRYING, (-0.09, -0.09)),
            "row 1, column 3; all as is meant; the next action does not go there: it knows and does not act",
            ("right place", "right stone", "does not go there"),
        ),
        (
            WRONG_XY,
            towards(CARRYING, WRONG_XY),
            "row 2, column 3, not row 1, column 3; it misreads the place",
            ("wrong place", "right stone", "goes there"),
        ),
        (
            WRONG_XY,
            STILL,
            "row 2, column 3, not row 1, column 3; it misreads the place; the next action does not go there",
            ("wrong place", "right stone", "does not go there"),
        ),
    ],
)
def test_misreading_is_told_from_not_acting(
    place_xy: tuple[float, float], action: np.ndarray, answer: str, names: tuple[str, ...]
) -> None:
    found = check(CARRYING, action, place_xy).finding
    assert (found.question, found.answer, found.names) == ("It points at:", answer, names)


def test_distances_are_in_millimetres_and_actions_in_those_that_they_lead() -> None:
    found = check(CARRYING, np.array([0.5, -0.25, 1.0, -1.0], np.float32), (0.048, 0.041), (0.006, 0.008))
    assert found.place_mm == pytest.approx(5) and found.stone_mm == pytest.approx(10)
    assert found.way_mm.tolist() == pytest.approx([20, -10])
    # the expert's fastest, 30 mm of 66, at height
    assert float(np.linalg.norm(found.asked_mm)) == pytest.approx(30, abs=0.1)
    assert found.asked_mm[0] / found.asked_mm[1] == pytest.approx(48 / 41, abs=0.01)


def test_of_absolute_actions_the_way_is_what_counts() -> None:
    state = replace(true_state(held=True, gripper_xyz=(0.02, 0.03, 0.06)), control_mode="absolute")
    asked = towards(state, MEANT_XY)
    there, still = (check(state, action) for action in (asked, np.array([0.02, 0.03, 0.06, -1])))
    relative = check(replace(state, control_mode="relative"), STILL)
    assert there.way_mm.tolist() == pytest.approx(relative.asked_mm.tolist(), abs=1e-3)
    assert still.way_mm.tolist() == pytest.approx([0, 0], abs=1e-9)
    assert there.goes_there and not still.goes_there


def test_a_stone_counts_until_it_is_held() -> None:
    # the gripper is above the tray, between both
    reaching, elsewhere = true_state(held=False, gripper_xyz=(0.170, 0.0, 0.06)), (0.170, -0.030)
    found = check(reaching, expert_action(reaching), stone_xy=elsewhere)
    assert found.finding.names == ("right place", "wrong stone", "does not go there")
    assert found.finding.answer == (
        "row 1, column 3; it misreads the stone by 60 mm; the next action does not go there"
    )
    # it goes where it points, which is not where the stone is
    moved = np.array(reaching.stone_xyz)
    moved[0, :2] = elsewhere
    assert check(reaching, expert_action(replace(reaching, stone_xyz=moved)), stone_xy=elsewhere).goes_there
    held = check(CARRYING, towards(CARRYING, MEANT_XY), stone_xy=(0.06, 0.0))
    assert held.goes_there and "stone" not in held.finding.answer


@pytest.mark.parametrize(
    ("xy", "name"),
    [
        ((0.045, 0.045), "row 1, column 3"),
        ((-0.1, -0.08), "row 4, column 0"),
        ((0.17, 0.092), "the tray"),
        ((-0.2, 0.0), "beside the board"),
        ((0.0, 0.126), "beside the board"),
    ],
)
def test_places_have_names(xy: tuple[float, float], name: str) -> None:
    assert place_name(np.array(xy)) == name


def test_json_says_it_in_numbers() -> None:
    chances = {(0.0, 0.0): 0.25, MEANT_XY: 0.75}
    found = json.loads(json.dumps(check(CARRYING, STILL, held=0.875, probabilities=chances).as_json()))
    assert found["place"] == found["meant_place"] == "row 1, column 3" and found["place_mm"] == 0
    assert found["place_xy_m"] == [0.045, 0.045] and found["stone_xy_m"] == [0, 0]
    assert (found["held"], found["meant_held"]) == (0.875, 1)
    assert found["places"] == [
        {"xy_m": [0.045, 0.045], "probability": 0.75},
        {"xy_m": [0, 0], "probability": 0.25},
    ]
    assert found["action_mm"] == [0, 0] and found["goes_there"] is False


# Pictures


def test_an_environments_cameras_see_the_target_where_it_is_drawn() -> None:
    with closing(make_env(SPEC, OPTIONS)) as env:
        env.reset(seed=SPEC.seed)
        mask = env.get_wrapper_attr("object_masks")()["workspace"]["target"]
        camera = env.get_wrapper_attr("cameras")()["workspace"]
    assert SPEC.target is not None
    x, y = camera.pixel_of([*BOARD.intersection_xy(*SPEC.target), BOARD.thickness_m])
    rows, columns = mask.nonzero()
    assert (x, y) == pytest.approx((columns.mean(), rows.mean()), abs=0.5)


def test_marks_are_drawn_where_they_are_seen() -> None:
    # 0.5 m above the world's origin, looking down: a metre is 20 pixels there
    intrinsics = np.array([[10, 0, 31.5], [0, 10, 31.5], [0, 0, 1.0]])
    world_from_camera = np.diag([1.0, -1.0, -1.0, 1.0])
    world_from_camera[2, 3] = 0.5
    mark = Mark(np.array([0.5, -0.25, 0.0]), PLACE_RGB, False, "row 1, column 3")
    shown = marked(np.zeros((64, 64, 3), np.uint8), PinholeCamera(intrinsics, world_from_camera), [mark])
    # its pixel (41.5, 36.5) of 64 is here of 448
    assert shown.shape == (MARKED_PX, MARKED_PX, 3)
    cross = shown[..., 0][255:264, 290:299] > 200
    rows, columns = cross.nonzero()
    assert (columns.mean() + 290, rows.mean() + 255) == pytest.approx((293.5, 258.5), abs=0.6)
    assert not shown[:, :270].any()


def test_the_page_says_it_in_rows() -> None:
    chances = {WRONG_XY: 0.995, TRAY_XY: 0.005}
    found = check(CARRYING, STILL, WRONG_XY, (0.003, 0.004), held=0.5, probabilities=chances)
    said, places = pointing_tables(found)
    assert [[cell.text for cell in row] for row in said.rows[:3]] == [
        ["place", "row 2, column 3", "row 1, column 3", "45.0"],
        ["stone, mm", "x 3, y 4", "x 0, y 0", "5.0"],
        ["held", "0.50", "1.00", "-"],
    ]
    assert said.note.startswith(f"It points at {found.finding.answer}. ")
    assert [[cell.text for cell in row] for row in places.rows] == [["row 2, column 3", "0.99"]]
    (without,) = pointing_tables(check(CARRYING, STILL))
    assert [row[0].text for row in without.rows] == ["place", "stone, mm", "next action, mm"]


def test_means_are_of_the_episodes_that_point() -> None:
    checks = [
        check(CARRYING, towards(CARRYING, MEANT_XY)),
        check(CARRYING, STILL),
        check(CARRYING, STILL, WRONG_XY),
        None,
    ]
    explanation = Explanation("loss", -1.0, {"image": torch.zeros(1, 1)}, {}, {}, {}, [])
    watched = Snapshot(0, "carry", {}, "Place it.", {}, {}, None, CARRYING, {})
    moments = [ExplainedMoment(watched, explanation, [], {}, {}, {}, each) for each in checks]
    (table,) = mean_pointing(moments)
    means = {row[0].text: row[1].value["value"] for row in table.rows}
    assert means == {
        "the place that is meant": pytest.approx(2 / 3),
        "the stone that is meant": 1,
        "the next action goes there": pytest.approx(1 / 3),
        "goes there, of those that point at the place": 0.5,
        "from the place, mm": pytest.approx(15),
        "from the stone, mm": 0,
    }
    assert [*mean_pointing(moments[-1:])] == []


# The command


def test_a_checkpoint_that_points_is_explained_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    end_episodes_after(5, monkeypatch)
    save_checkpoint("fdvla", tmp_path / "checkpoint", **POINTING["fdvla"], chunk_size=1, n_action_steps=1)
    flags = [f"--policy.path={tmp_path / 'checkpoint'}", "--seed=100003", "--grid=1", "--fill=other"]
    assert main(["explain", *flags, "--step=0", f"--output={tmp_path / 'why'}"]) == 0
    (moment,) = json.loads((tmp_path / "why" / "explanation.json").read_text())["moments"]
    found = moment["pointing"]
    assert found["place_xy_m"] in np.array(PLACES, np.float32).tolist()
    assert sum(each["probability"] for each in found["places"]) == pytest.approx(1, abs=1e-5)
    assert moment["findings"]["It points at:"][0] in ("right place", "wrong place")
    told = "It misreads the place" if found["place"] != found["meant_place"] else "It points at the place"
    assert told in capsys.readouterr().out
    page = (tmp_path / "why" / "explanation.html").read_text()
    assert page.count("<img ") == 1 + 2 + 1 and "What it points at" in page
    assert f"({found['meant_place']} is meant)" in page
