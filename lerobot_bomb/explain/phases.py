"""Phases of an episode of BOMB, named by what the gripper does, whatever it was told to do."""

from collections.abc import Sequence

import numpy as np

from lerobot_bomb.bomb.board import BOARD
from lerobot_bomb.bomb.expert import current_goal, held_share
from lerobot_bomb.bomb.pointing import HELD
from lerobot_bomb.bomb.privileged_state import PrivilegedState

REACH, GRASP, CARRY, PLACE = "reach", "grasp", "carry", "place"
PHASES = (REACH, GRASP, CARRY, PLACE)
DOES = {
    REACH: "moves with open or empty fingers",
    GRASP: "has its fingers around {}",
    CARRY: "carries {}",
    PLACE: "is at the target, or where it lets go of {}",
}
NEAR_M = BOARD.pitch_m  # of the place where a stone is put down: it is being placed
CARRIED_M = 0.005  # from where it was taken: the stone is carried


def phases_of(states: Sequence[PrivilegedState]) -> list[tuple[str, int | None]]:
    """Return the phase of each state of an episode, and the stone that it is about.

    reach: no stone is between the fingers. grasp: one is, but it has not been carried. carry: it is held away
    from where it was taken. place: near where it is let go, or its target, and then until the gripper leaves.
    """
    found: list[tuple[str, int | None]] = []
    taken_xyz: dict[int, np.ndarray] = {}  # of the stone in the fingers, where it was taken
    for i, state in enumerate(states):
        stone = _between_fingers(state)
        if stone is None:
            taken_xyz = {}
            found.append(found[-1] if found and _is_leaving(state, *found[-1]) else (REACH, None))
            continue
        start_xyz = taken_xyz.setdefault(stone, state.stone_xyz[stone])
        is_held = held_share(state, stone) >= HELD
        is_carried = float(np.linalg.norm(state.stone_xyz[stone] - start_xyz)) > CARRIED_M
        was_carried = bool(found) and found[-1] in ((CARRY, stone), (PLACE, stone))
        if not is_held:
            found.append((PLACE if was_carried else GRASP, stone))
        elif not is_carried and not was_carried:
            found.append((GRASP, stone))
        else:
            found.append((PLACE if _is_placing(states, i, stone) else CARRY, stone))
    return found


def _between_fingers(state: PrivilegedState) -> int | None:
    """Return the stone that the fingers hold or are around; None without one."""
    offsets = state.stone_xyz - state.gripper_xyz
    beside_m = np.where(state.stone_in_play, np.linalg.norm(offsets[:, :2], axis=1), np.inf)
    stone = int(beside_m.argmin())
    is_around = beside_m[stone] < state.stone_radius_m and offsets[stone, 2] > -state.stone_half_height_m
    return stone if is_around else None


def _is_leaving(state: PrivilegedState, phase: str, stone: int | None) -> bool:
    """Return True while the gripper is above the stone that it has put down."""
    if phase != PLACE or stone is None:
        return False
    return float(np.linalg.norm((state.stone_xyz[stone] - state.gripper_xyz)[:2])) <= NEAR_M


def _is_placing(states: Sequence[PrivilegedState], now: int, stone: int) -> bool:
    """Return True if a held stone is near its target, or near where the fingers will let go of it."""
    state = states[now]
    goal, xy = current_goal(state), state.stone_xyz[stone, :2]
    is_near = goal.stone == stone and float(np.linalg.norm(xy - goal.xyz[:2])) <= NEAR_M
    left = next((each for each in states[now:] if held_share(each, stone) < HELD), None)
    return is_near or (left is not None and float(np.linalg.norm(xy - left.stone_xyz[stone, :2])) <= NEAR_M)


def gripper_does(phase: str, stone: int | None, state: PrivilegedState) -> str:
    """Say what the gripper does: "carries the stone that is meant"."""
    is_meant = stone == current_goal(state).stone
    return DOES[phase].format("the stone that is meant" if is_meant else "another stone")
