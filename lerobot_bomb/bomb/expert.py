"""A scripted expert that moves stones one by one, without memory or pauses, so that it can be imitated.

Its action is a continuous function of what an observation shows: gripper, measured finger opening,
stones, target. It keeps no phase and no counter, and never reads `PrivilegedState.stage`.
"""

from dataclasses import replace
from functools import reduce
from itertools import pairwise
from operator import add

import numpy as np

from lerobot_bomb.bomb import so101
from lerobot_bomb.bomb.episode import DEFAULT_FPS
from lerobot_bomb.bomb.observation import MAX_STEP_M, WORKSPACE_HIGH_M, WORKSPACE_LOW_M
from lerobot_bomb.bomb.privileged_state import Goal, PrivilegedState

SPEED_M_S = 0.30  # at most, horizontally and vertically each
GAIN = 0.75  # share of the remaining way that a step of 0.1 s covers near its goal

GRASP_DEPTH_M = 0.0028  # of the pads' lower ends below the stone's centre
GRASP_SLACK_M = 0.004  # that a held stone may sit too high between the pads
FLOOR_M = WORKSPACE_LOW_M[2] + 0.0007  # lowest height commanded to the gripper
PRESS_M = 0.0015  # how far below its goal a descent aims, as it slows down near its aim
RETREAT_HEIGHT_M = 0.11  # of the gripper after the release

# Finger openings.
SQUEEZE_M = 0.001  # that a held stone measures less than its diameter
EMPTY_M = (-0.008, -0.005)  # from the diameter: closed on nothing .. a stone may be between the pads
# in shares of the way from the stone's diameter to open fingers
HELD_SHARE = (0.045, 0.220)  # holds a stone .. does not yet
OPEN_SHARE = (0.330, 0.720)  # still touches a stone .. is clear of it

# a stone is between the pads: beside, below and above their lower ends
ENCLOSED_BESIDE_M = (0.008, 0.012)
ENCLOSED_BELOW_M = (-0.004, -0.002)
ENCLOSED_ABOVE_M = (0.020, 0.030)

# Approach: over the stone, down a funnel, close.
HOVER_M = 0.040  # pads above their grasping height while the gripper is off to the side
FUNNEL_SLOPE = 4.0  # metres of height per metre of lateral error
FUNNEL_MOUTH_M = 0.003  # lateral error at which the funnel reaches the ground
CLOSE_LATERAL_M = 0.0060  # lateral error below which the fingers close
CLOSE_HEIGHT_M = 0.0040  # height above the grasp below which the fingers close
CLOSE_GAIN = 4.0
# low fingers do not move sideways, unless near the stone
FREE_ABOVE_M = (0.006, 0.016)
FREE_BESIDE_M = (0.005, 0.009)

# Carrying: up, across, down a funnel, release.
CARRY_M = 0.028  # stone above its resting height; clears stones on the board by more than their height
CARRY_SLOPE = 3.0
CARRY_MOUTH_M = 0.0020
CLEARANCE_M = (0.006, 0.013)  # stone's height: creep sideways .. full speed
CREEP_M = 0.004  # per step of 0.1 s
RELEASE_LATERAL_M = (0.0040, 0.0070)  # a stone this near is in place: in closed .. in open fingers
RELEASE_HEIGHT_M = (0.0025, 0.0040)
RELEASE_SHARE = (0.0, 0.3)  # of these distances, from their ends: not yet .. in place
SLIDE_M = 0.006  # per step of 0.1 s, of a stone that stays on the board

# Several stones: the next one's turn comes when a stone lies within these distances of its place ..
REACHED_LATERAL_M = (0.006, 0.009)
REACHED_HEIGHT_M = (0.0030, 0.0050)
# .. and the fingers are this far above its grasp, or beside it
OFF_ABOVE_M = (0.008, 0.016)
OFF_BESIDE_M = (0.022, 0.032)

# Gripper command between which the jaw of control mode `joints` closes; elsewhere it closes below 0.
JAW_COMMAND = (-0.2, 0.2)
JAW_SQUEEZE_M = 0.004  # that closed jaws are commanded to be nearer to the grip point than a stone lets them


def expert_action(state: PrivilegedState) -> np.ndarray:
    """(D,) float32 action that brings each goal's stone to its place, in the control mode of the state.

    Relative: units of `MAX_STEP_M`, within [-1, 1]; absolute: metres within the workspace; joints: degrees,
    the jaw's in percent.
    """
    tempo = DEFAULT_FPS / state.fps
    motions_m, grippers = [], []
    shares = _shares(state)
    for goal, share in shares:
        motion_m, gripper = _plan(_anticipate(replace(state, goals=(goal,))), tempo)
        motions_m.append(share * motion_m)
        grippers.append(share * gripper)
    motion_m, gripper = reduce(add, motions_m), reduce(add, grippers)
    if state.control_mode == "relative":
        return np.array([*np.clip(motion_m / MAX_STEP_M, -1, 1), gripper], dtype=np.float32)
    gripper_xyz = state.gripper_xyz + state.pending_motion_m
    xyz = np.clip(gripper_xyz + motion_m, WORKSPACE_LOW_M, WORKSPACE_HIGH_M)
    if state.control_mode == "absolute":
        return np.array([*xyz, gripper], dtype=np.float32)
    return _joints(state, _largest(shares).stone, xyz, gripper)


def current_goal(state: PrivilegedState) -> Goal:
    """Return the goal with the largest share of an action."""
    return _largest(_shares(state))


def held_share(state: PrivilegedState, stone: int) -> float:
    """Return how firmly the fingers hold a stone, in [0, 1]."""
    return _held(state, state.stone_xyz[stone])


def _joints(state: PrivilegedState, stone: int, gripper_xyz: np.ndarray, gripper: float) -> np.ndarray:
    """(6,) float32: joints that bring the gripper there, with the jaw at a gripper command in [-1, 1]."""
    squeezed_m = state.stone_radius_m - JAW_SQUEEZE_M
    commanded_m = _between(_ramp(gripper, *JAW_COMMAND), (squeezed_m, state.max_opening_m / 2))
    jaw = float(so101.jaw_rad(commanded_m))
    stone_m = _enclosed(state, state.stone_xyz[stone]) * state.stone_radius_m
    expected_m = so101.expected_half_opening_m(jaw, state.finger_opening / 2, stone_m)
    joints = np.clip(so101.joints_at(gripper_xyz, expected_m), so101.LOW_RAD, so101.HIGH_RAD)
    joints[-1] = jaw
    return so101.to_driver(joints).astype(np.float32)


def _largest(shares: list[tuple[Goal, float]]) -> Goal:
    return max(shares, key=lambda each: each[1])[0]


def _shares(state: PrivilegedState) -> list[tuple[Goal, float]]:
    """Return the goals that an action serves, with their shares: the goal after the last one reached.

    While the fingers leave a stone that they have put down, its goal and the next one each have a share.
    """
    shares, left = [], 1.0
    for before, goal in reversed(list(pairwise(state.goals))):
        if (reached := _reached(state, before)) > 0:
            shares.append((goal, left * reached))
            left *= 1 - reached
    return [*shares, (state.goals[0], left)] if left > 0 else shares


def _reached(state: PrivilegedState, goal: Goal) -> float:
    """Return how far, in [0, 1], the goal's stone lies on its place with the fingers off it."""
    stone_xyz = state.stone_xyz[goal.stone]
    lateral_m = float(np.linalg.norm((goal.xyz - stone_xyz)[:2]))
    height_m = abs(float(stone_xyz[2] - goal.xyz[2]))
    lies = (1 - _ramp(lateral_m, *REACHED_LATERAL_M)) * (1 - _ramp(height_m, *REACHED_HEIGHT_M))
    above_m = float(state.gripper_xyz[2]) - _grasp_z(stone_xyz)
    beside_m = float(np.linalg.norm((state.gripper_xyz - stone_xyz)[:2]))
    return lies * max(_ramp(above_m, *OFF_ABOVE_M), _ramp(beside_m, *OFF_BESIDE_M))


def _anticipate(state: PrivilegedState) -> PrivilegedState:
    """Return the state after the commands that latency still holds back."""
    stone, stone_xyz = state.goals[0].stone, state.stone_xyz.copy()
    stone_xyz[stone] += _held(state, stone_xyz[stone]) * state.pending_motion_m
    state = replace(state, gripper_xyz=state.gripper_xyz + state.pending_motion_m, stone_xyz=stone_xyz)
    if state.pending_gripper == 0:
        return state
    closed_m = _enclosed(state, stone_xyz[stone]) * (2 * state.stone_radius_m - SQUEEZE_M)
    opening_m = state.max_opening_m if state.pending_gripper > 0 else min(closed_m, state.finger_opening)
    return replace(state, finger_opening=opening_m)


def _plan(state: PrivilegedState, tempo: float) -> tuple[np.ndarray, float]:
    """Displacement (3,) in metres and gripper command in [-1, 1] for a step of `tempo` x 0.1 s."""
    stone_xyz = state.stone_xyz[state.goals[0].stone]
    is_placed = _placed(state, stone_xyz)
    is_held = _held(state, stone_xyz)
    approach_m, approach_gripper = _approach(state, stone_xyz, tempo)
    carry = _slide if state.goals[0].is_slid else _carry
    carry_m = carry(state, stone_xyz, tempo)
    retreat_m = _retreat(state, tempo)
    motion_m = is_placed * retreat_m + (1 - is_placed) * (is_held * carry_m + (1 - is_held) * approach_m)
    gripper = is_placed + (1 - is_placed) * ((1 - is_held) * approach_gripper - is_held)
    return motion_m, gripper


def _placed(state: PrivilegedState, stone_xyz: np.ndarray) -> float:
    """Return how well the stone lies on the target, in [0, 1]; wider fingers tolerate more.

    A release moves the stone a little; the expert must not grasp it again for that.
    """
    openness = _openness(state, (HELD_SHARE[0], OPEN_SHARE[0]))
    lateral_m = float(np.linalg.norm((state.goals[0].xyz - stone_xyz)[:2]))
    height_m = float(stone_xyz[2] - state.goals[0].xyz[2])
    # fingers that are as low as they go cannot lower a stone that they hold too high
    height_m = max(min(height_m, state.gripper_xyz[2] - FLOOR_M), height_m - GRASP_SLACK_M)
    inside = min(
        1 - lateral_m / _between(openness, RELEASE_LATERAL_M),
        1 - height_m / _between(openness, RELEASE_HEIGHT_M),
    )
    return _ramp(inside, *RELEASE_SHARE)


def _held(state: PrivilegedState, stone_xyz: np.ndarray) -> float:
    """Return how firmly the fingers hold the stone, in [0, 1]."""
    play_m = state.finger_opening - 2 * state.stone_radius_m
    return _enclosed(state, stone_xyz) * (1 - _openness(state, HELD_SHARE)) * _ramp(play_m, *EMPTY_M)


def _openness(state: PrivilegedState, shares: tuple[float, float]) -> float:
    """Return how far the fingers are open, in [0, 1], between two shares of their play around a stone."""
    diameter_m = 2 * state.stone_radius_m
    return _ramp((state.finger_opening - diameter_m) / (state.max_opening_m - diameter_m), *shares)


def _enclosed(state: PrivilegedState, stone_xyz: np.ndarray) -> float:
    """Return how far the stone is between the pads, in [0, 1]."""
    offset = stone_xyz - state.gripper_xyz
    beside = 1 - _ramp(float(np.linalg.norm(offset[:2])), *ENCLOSED_BESIDE_M)
    return beside * _ramp(offset[2], *ENCLOSED_BELOW_M) * (1 - _ramp(offset[2], *ENCLOSED_ABOVE_M))


def _approach(state: PrivilegedState, stone_xyz: np.ndarray, tempo: float) -> tuple[np.ndarray, float]:
    """Displacement and gripper command that bring open fingers around the stone and close them."""
    grasp_z = _grasp_z(stone_xyz)
    offset_xy = (stone_xyz - state.gripper_xyz)[:2]
    lateral_m = float(np.linalg.norm(offset_xy))
    above_m = state.gripper_xyz[2] - grasp_z
    enclosed = _enclosed(state, stone_xyz)
    funnel_m = np.clip((lateral_m - FUNNEL_MOUTH_M) * FUNNEL_SLOPE, 0, HOVER_M)
    # closed fingers would come down on the stone
    shut_m = HOVER_M * (1 - _openness(state, OPEN_SHARE)) * (1 - enclosed)
    rise_m = max(funnel_m, shut_m) - PRESS_M - above_m
    # away from the stone, low fingers would sweep others off the board: first up, then across
    freedom = max(_ramp(above_m, *FREE_ABOVE_M), 1 - _ramp(lateral_m, *FREE_BESIDE_M))
    motion_m = _step(offset_xy, rise_m, freedom, tempo)
    inside = min(
        1 - lateral_m / CLOSE_LATERAL_M,
        1 - above_m / CLOSE_HEIGHT_M,
        (state.finger_opening - 2 * state.stone_radius_m - EMPTY_M[0]) / CLOSE_HEIGHT_M,
    )
    return motion_m, float(np.clip(-CLOSE_GAIN * inside, -1, 1))


def _carry(state: PrivilegedState, stone_xyz: np.ndarray, tempo: float) -> np.ndarray:
    """Displacement (3,) that brings the held stone over the target and down."""
    offset_xy = (state.goals[0].xyz - stone_xyz)[:2]
    height_m = float(stone_xyz[2] - state.goals[0].xyz[2])
    lateral_m = float(np.linalg.norm(offset_xy))
    funnel_m = float(np.clip((lateral_m - CARRY_MOUTH_M) * CARRY_SLOPE, 0, CARRY_M))
    freedom = max(_ramp(height_m, *CLEARANCE_M), CREEP_M / (SPEED_M_S / DEFAULT_FPS))
    return _step(offset_xy, funnel_m - PRESS_M - height_m, freedom, tempo)


def _slide(state: PrivilegedState, stone_xyz: np.ndarray, tempo: float) -> np.ndarray:
    """Displacement (3,) that draws the stone between the pads along the board to the target."""
    offset = state.goals[0].xyz - stone_xyz
    return _step(offset[:2], float(offset[2]), SLIDE_M / (SPEED_M_S / DEFAULT_FPS), tempo)


def _retreat(state: PrivilegedState, tempo: float) -> np.ndarray:
    """Displacement (3,) straight up, as soon as the fingers are clear of the stone."""
    rise_m = max(0.0, RETREAT_HEIGHT_M - state.gripper_xyz[2]) * _openness(state, OPEN_SHARE)
    return _step(np.zeros(2), rise_m, 1.0, tempo)


def _grasp_z(stone_xyz: np.ndarray) -> float:
    """Height in metres of the gripper that grasps the stone."""
    return max(float(stone_xyz[2]) - GRASP_DEPTH_M, FLOOR_M)


def _step(offset_xy: np.ndarray, rise_m: float, freedom: float, tempo: float) -> np.ndarray:
    """(3,) metres: the part of the way that one step covers; `freedom` in [0, 1] slows it sideways."""
    limit_m = SPEED_M_S / DEFAULT_FPS * tempo
    gain = 1 - (1 - GAIN) ** tempo
    wanted_xy = gain * offset_xy
    length_m = float(np.linalg.norm(wanted_xy))
    wanted_xy = wanted_xy * min(1.0, freedom * limit_m / length_m) if length_m > 0 else wanted_xy
    return np.array([*wanted_xy, np.clip(gain * rise_m, -limit_m, limit_m)])


def _ramp(value: float, low: float, high: float) -> float:
    """Ramp from 0 at `low` to 1 at `high`, constant beyond both."""
    return float(np.clip((value - low) / (high - low), 0, 1))


def _between(share: float, ends: tuple[float, float]) -> float:
    return ends[0] + share * (ends[1] - ends[0])
