"""Grasps of a part: opposite walls between the pads, free of everything else."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_bomb.libero.expert import angle_of
from lerobot_env_bomb.libero.expert.arm import Pose
from lerobot_env_bomb.libero.expert.surfaces import Surface

# the Panda's gripper, relative to the point between the pads
PAD_HALF_WIDTH_M = 0.008
PAD_M = (-0.012, 0.004)  # of a pad, along the approach
FINGER_M = (-0.0525, 0.0105)  # of a finger, the same
FINGER_HALF_WIDTH_M = 0.0107
OPEN_M = (0.039, 0.065)  # of an open finger, along the fingers' axis
PALM_M = (-0.12, -0.027)
PALM_HALF_M = (0.104, 0.032)  # along the fingers' axis and across
SLACK_M = 0.003  # between open fingers and what they are put around
OFFSETS_M = (0.0, 0.012, -0.012, 0.022, -0.022)  # of the walls from the middle of the gripper
MAX_POINTS = 220
MIN_CONTACTS = 3
TOUCH_M = 0.004  # depth of what a pad touches
FLIPS = (1, -1)
FACING = 0.75  # cosine between walls' normals and the fingers' axis, at least


@dataclass(frozen=True)
class Grasp:
    """A pose of the open gripper around two opposite walls."""

    pose: Pose
    approach: np.ndarray  # (3,) unit vector along which the gripper arrives
    cost: float


def grasps_of(
    surface: Surface,
    grip: Pose,
    approaches: Sequence[np.ndarray],
    lowest_m: float = -np.inf,
    offsets: Sequence[float] = OFFSETS_M,
    rolls: Sequence[float] = (0.0,),
    count: int = MAX_POINTS,
) -> list[Grasp]:
    """Return the grasps of a part, the best first.

    Args:
        surface: of the part.
        grip: pose of the gripper now; turning far from it costs.
        approaches: unit vectors along which the gripper may arrive.
        lowest_m: height below which the point between the pads may not come.
        offsets: metres, of the walls from the middle of the gripper.
        rolls: radians, of the gripper about its approach.
        count: points of the surface that are tried, at most.
    """
    found = []
    for approach in approaches:
        found += _along(surface, grip, approach, lowest_m, offsets, rolls, count)
    return sorted(found, key=lambda grasp: grasp.cost)


def _along(
    surface: Surface,
    grip: Pose,
    approach: np.ndarray,
    lowest_m: float,
    offsets: Sequence[float],
    rolls: Sequence[float],
    count: int,
) -> list[Grasp]:
    across = surface.normals - (surface.normals @ approach)[:, None] * approach
    length = np.linalg.norm(across, axis=1)
    candidates = np.flatnonzero(length >= FACING)
    candidates = candidates[:: max(1, len(candidates) // count)]
    found = []
    for index, roll_rad in itertools.product(candidates.tolist(), rolls):
        normal = across[index] / length[index]
        axis = np.cos(roll_rad) * normal + np.sin(roll_rad) * np.cross(approach, normal)
        side = np.cross(approach, axis)
        local = (surface.points - surface.points[index]) @ np.stack([axis, side, approach], 1)
        middle_m = _middle(local, surface.normals @ axis)
        if middle_m is None:
            continue
        for offset_m in offsets:
            shift_m = middle_m + offset_m
            xyz = surface.points[index] + shift_m * axis
            if xyz[2] < lowest_m or not _is_free(local - [shift_m, 0, 0]):
                continue
            found += [
                Grasp(pose, approach, _cost(pose, grip, surface, offset_m))
                for pose in (Pose(xyz, _frame(axis * flip, approach)) for flip in FLIPS)
            ]
    return found


def _middle(local: np.ndarray, facing_axis: np.ndarray) -> float | None:
    """Return the middle of what pads would squeeze, relative to the first point; None if it is no grasp."""
    between = (abs(local[:, 1]) < PAD_HALF_WIDTH_M) & (local[:, 2] > PAD_M[0]) & (local[:, 2] < PAD_M[1])
    along, facing_axis = local[between, 0], facing_axis[between]
    opposite = along[(facing_axis < -FACING) & (along < 0)]
    if not len(opposite):
        return None
    is_squeezed = abs(along - opposite.max() / 2) < OPEN_M[0] - SLACK_M  # about the nearest wall
    along, facing_axis = along[is_squeezed], facing_axis[is_squeezed]
    if not len(along):
        return None
    low, high = along.min(), along.max()
    touches_low = (facing_axis < -FACING) & (along < low + TOUCH_M)
    touches_high = (facing_axis > FACING) & (along > high - TOUCH_M)
    if min(touches_low.sum(), touches_high.sum()) < MIN_CONTACTS:
        return None
    return float((low + high) / 2)


def _is_free(local: np.ndarray) -> bool:
    """Return True if no point (n, 3) along fingers' axis, across, approach is in open fingers or palm."""
    along, across, down = abs(local[:, 0]), abs(local[:, 1]), local[:, 2]
    finger = (along > OPEN_M[0] - SLACK_M) & (along < OPEN_M[1] + SLACK_M)
    finger &= (across < FINGER_HALF_WIDTH_M + SLACK_M) & (down > FINGER_M[0]) & (down < FINGER_M[1] + SLACK_M)
    palm = (along < PALM_HALF_M[0]) & (across < PALM_HALF_M[1]) & (down > PALM_M[0]) & (down < PALM_M[1])
    return not (finger | palm).any()


def _frame(axis: np.ndarray, approach: np.ndarray) -> np.ndarray:
    """(3, 3) orientation of a gripper whose fingers move along an axis: its columns x, y, z."""
    return np.stack([axis, np.cross(approach, axis), approach], 1)


def _cost(pose: Pose, grip: Pose, surface: Surface, offset_m: float) -> float:
    """Add radians that the gripper turns, and centimetres from the part's middle and of a shallow grasp."""
    middle = surface.points.mean(0)
    along = (pose.xyz - middle) @ pose.mat[:, 2]
    beside_m = float(np.linalg.norm((pose.xyz - middle) - along * pose.mat[:, 2]))
    return angle_of(pose.mat @ grip.mat.T) + 40 * abs(offset_m) + 2 * beside_m - 15 * along
