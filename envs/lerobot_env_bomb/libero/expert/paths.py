"""Paths of the gripper that keep their distance from everything: up, across, down."""

from collections.abc import Iterable, Iterator
from itertools import pairwise

import numpy as np

from lerobot_bomb.libero.expert import angle_of, rotation_vector
from lerobot_env_bomb.libero.expert.arm import Arm, Held, Pose
from lerobot_env_bomb.shared.rotations import rotation

HEIGHTS_M = (0.0, 0.04, 0.08, 0.12, 0.18, 0.25, 0.32)  # above the higher end
DETOURS_M = (0.0, -0.15, 0.15, -0.25, 0.25)  # sideways, of the middle of a path
STEP_M, STEP_RAD = 0.025, 0.25  # between poses that are looked at
KEPT_M = 0.008  # distance that a path keeps
LEAVING_M = 0.06  # from the ends, where a path need only not overlap anything
OVERLAP_M = -0.003
STEEP = 0.6  # least downward share of the direction in which a gripper points, to come from above along it


def straight_way(start: Pose, end: Pose) -> Iterator[Pose]:
    """Yield poses on the straight way, the end included."""
    turn = rotation_vector(end.mat @ start.mat.T)
    angle_rad = float(np.linalg.norm(turn))
    axis = turn / angle_rad if angle_rad > 1e-6 else np.array([0.0, 0.0, 1.0])
    way = end.xyz - start.xyz
    count = max(1, int(np.ceil(max(np.linalg.norm(way) / STEP_M, angle_rad / STEP_RAD))))
    for share in np.arange(1, count + 1) / count:
        yield Pose(start.xyz + share * way, rotation(axis, share * angle_rad) @ start.mat)


def find_path(
    arm: Arm, goal: Pose, held: Held | None, opening_m: float, start: Pose | None = None
) -> list[Pose] | None:
    """Return the corners of a free path to a pose; None if none is found.

    Args:
        arm: copy of the scene's.
        goal: pose of the gripper at the end.
        held: object in the gripper.
        opening_m: of the fingers.
        start: pose of the gripper at the beginning; None: where the scene has it.
    """
    arm.mirror()
    if start is None:
        start = arm.grip
    elif not arm.reach(start, arm.joints, arm.rest):
        return None
    joints = arm.joints
    for corners in _candidates(start, goal):
        if _is_free(arm, [start, *corners], joints, held, opening_m):
            return corners
    return None


def _candidates(start: Pose, goal: Pose) -> Iterator[list[Pose]]:
    if angle_of(goal.mat @ start.mat.T) < STEP_RAD:
        yield [goal]
    across = np.cross([0, 0, 1.0], goal.xyz - start.xyz)
    across /= max(float(np.linalg.norm(across)), 1e-6)
    for detour_m in DETOURS_M:
        for height_m in HEIGHTS_M:
            top_m = max(start.xyz[2], goal.xyz[2]) + height_m
            up, over = _raised(start, top_m), _raised(goal, top_m)
            middle = Pose((up.xyz + over.xyz) / 2 + detour_m * across, goal.mat)
            yield [up, *([middle] if detour_m else []), over, goal]


def _raised(pose: Pose, height_m: float) -> Pose:
    """Return the pose drawn back to a height, the way that the gripper points if that is steep enough."""
    pointing = pose.mat[:, 2]
    back = -pointing / -pointing[2] if -pointing[2] > STEEP else np.array([0, 0, 1.0])
    return pose.shifted((height_m - pose.xyz[2]) * back)


def _is_free(arm: Arm, corners: list[Pose], joints: np.ndarray, held: Held | None, opening_m: float) -> bool:
    arm.mirror()
    first, last = corners[0].xyz, corners[-1].xyz
    for one, other in pairwise(corners):
        for pose in straight_way(one, other):
            near_m = min(np.linalg.norm(pose.xyz - first), np.linalg.norm(pose.xyz - last))
            kept_m = OVERLAP_M if near_m < LEAVING_M else KEPT_M
            if not _is_free_at(arm, pose, joints, held, opening_m, kept_m):
                return False
            joints = arm.joints
    return True


def is_free_way(
    arm: Arm,
    way: Iterable[Pose],
    held: Held | None,
    opening_m: float,
    kept_m: float,
    ignored: np.ndarray | None = None,
) -> bool:
    """Return True if the arm passes these poses one after the other, and keeps a distance there.

    `ignored`: (geoms,) bool, what it may touch.
    """
    arm.mirror()
    joints = arm.joints
    for pose in way:
        if not _is_free_at(arm, pose, joints, held, opening_m, kept_m, ignored):
            return False
        joints = arm.joints
    return True


def _is_free_at(
    arm: Arm,
    pose: Pose,
    joints: np.ndarray,
    held: Held | None,
    opening_m: float,
    kept_m: float,
    ignored: np.ndarray | None = None,
) -> bool:
    if not arm.reach(pose, joints, arm.rest):
        return False
    arm.set_fingers(opening_m)
    arm.hold(held)
    return arm.clearance_m(held, ignored) >= kept_m
