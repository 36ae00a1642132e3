"""Phases of an episode, by what the gripper does."""

from dataclasses import replace

import numpy as np
import pytest

from lerobot_bomb.bomb.board import BOARD, NUM_STONES
from lerobot_bomb.bomb.expert import GRASP_DEPTH_M, SQUEEZE_M
from lerobot_bomb.bomb.privileged_state import Goal, PrivilegedState
from lerobot_bomb.explain.phases import gripper_does, phases_of

REST_M = BOARD.thickness_m + BOARD.stone_height_m / 2
OPEN_M, CLOSED_M = 0.044, 2 * BOARD.stone_radius_m - SQUEEZE_M
TRAY_XY, TARGET_XY, OTHER_XY = (0.170, 0.030), (0.045, 0.045), (-0.09, -0.09)
HIGH_M = 0.04  # of the gripper above its grasp


def state(
    gripper_xy: tuple[float, float], height_m: float, *, closed: bool, stone: int | None = None, **lies: tuple
) -> PrivilegedState:
    """Gripper above a place; it holds ``stone``, or the stones lie where ``lies`` says: s0, s1."""
    x, y = gripper_xy
    gripper = np.array([x, y, REST_M - GRASP_DEPTH_M + height_m])
    stone_xyz = np.tile([1.0, 1.0, REST_M], (NUM_STONES, 1))
    for i, default in enumerate((TRAY_XY, OTHER_XY)):
        stone_xyz[i, :2] = lies.get(f"s{i}", default)
    if stone is not None:
        stone_xyz[stone] = [x, y, gripper[2] + GRASP_DEPTH_M]
    return PrivilegedState(
        gripper_xyz=gripper,
        finger_opening=CLOSED_M if closed else OPEN_M,
        goals=(Goal(np.array([*TARGET_XY, REST_M]), 0),),
        stone_xyz=stone_xyz,
        stone_is_white=np.arange(NUM_STONES) > 0,
        stone_in_play=np.arange(NUM_STONES) < 2,
    )


def names(states: list[PrivilegedState]) -> list[str]:
    return [f"{phase} {stone}" for phase, stone in phases_of(states)]


def test_a_stone_is_taken_carried_and_put_down() -> None:
    states = [
        state((0.1, 0.0), HIGH_M, closed=False),
        state(TRAY_XY, 0.0, closed=False),
        state(TRAY_XY, 0.0, closed=True, stone=0),
        state(TRAY_XY, 0.02, closed=True, stone=0),
        state((0.12, 0.04), HIGH_M, closed=True, stone=0),
        state((0.05, 0.045), HIGH_M, closed=True, stone=0),
        state(TARGET_XY, 0.0, closed=True, stone=0),
        state(TARGET_XY, 0.0, closed=False, s0=TARGET_XY),
        state(TARGET_XY, HIGH_M, closed=False, s0=TARGET_XY),
        state((-0.05, -0.05), HIGH_M, closed=False, s0=TARGET_XY),
    ]
    assert names(states) == [
        "reach None", "grasp 0", "grasp 0", "carry 0", "carry 0", "place 0", "place 0", "place 0", "place 0",
        "reach None",
    ]  # fmt: skip


def test_another_stone_put_elsewhere_is_carried_and_placed_too() -> None:
    elsewhere = (0.0, -0.09)
    states = [
        state(OTHER_XY, 0.0, closed=True, stone=1),
        state((-0.08, -0.09), HIGH_M, closed=True, stone=1),
        state((-0.02, -0.09), HIGH_M, closed=True, stone=1),
        state(elsewhere, 0.0, closed=True, stone=1),
        state(elsewhere, 0.0, closed=False, s1=elsewhere),
    ]
    assert names(states) == ["grasp 1", "carry 1", "place 1", "place 1", "place 1"]
    assert gripper_does("carry", 1, states[1]) == "carries another stone"
    assert gripper_does("carry", 0, states[1]) == "carries the stone that is meant"
    assert gripper_does("reach", None, states[1]) == "moves with open or empty fingers"


def test_a_missed_grasp_is_followed_by_another_reach() -> None:
    states = [
        state(TRAY_XY, 0.0, closed=False),
        state(TRAY_XY, HIGH_M, closed=True),
        state((0.1, 0.0), HIGH_M, closed=True),
    ]
    assert names(states) == ["grasp 0", "reach None", "reach None"]


@pytest.mark.parametrize("states", [[], [state((0.1, 0.0), HIGH_M, closed=False)]])
def test_each_state_has_a_phase(states: list[PrivilegedState]) -> None:
    assert len(phases_of(states)) == len(states)


def test_fingers_are_around_a_tall_stone() -> None:
    low = state(TRAY_XY, 0.0, closed=False)
    rest_m = REST_M + 0.00125  # 5.75 mm above the board
    stone_xyz, goal = low.stone_xyz.copy(), Goal(np.array([*TARGET_XY, rest_m]), 0)
    stone_xyz[:2, 2] = rest_m
    over_middle = stone_xyz[0] + np.array([0, 0, 0.005])
    assert names([replace(low, gripper_xyz=over_middle, stone_xyz=stone_xyz, goals=(goal,))]) == ["grasp 0"]
