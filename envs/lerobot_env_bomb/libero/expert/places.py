"""Places of an object that LIBERO's own predicate accepts."""

from collections.abc import Iterator, Sequence

import numpy as np

from lerobot_env_bomb.libero.expert.arm import Arm, Pose
from lerobot_env_bomb.shared.rotations import rotation

SHARES = (0.0, -0.35, 0.35, -0.7, 0.7)  # of a region's half size, from its middle
ABOVE_M = 0.25  # height over a target from which an object is lowered
FALL_M = 0.4
STEP_M, EXACT_M = 0.008, 0.0005
MAX_OVERLAP_M = 0.02


def resting_places(arm: Arm, goal: Sequence[str], body: int) -> list[Pose]:
    """Return poses in which an object rests and the goal holds, the middle ones first."""
    arm.mirror()
    upright = arm.body(body).mat
    found = []
    for xyz in _spots(arm, goal[2]):
        pose = _lowered(arm, body, Pose(xyz + np.array([0, 0, ABOVE_M]), upright))
        if pose is not None and arm.task.holds(goal, arm.data):
            found.append(pose)
    arm.mirror()
    return found


def _spots(arm: Arm, target: str) -> Iterator[np.ndarray]:
    """Yield points (3,) of a region, or an object's middle."""
    sites = arm.task.sites
    if target not in sites:
        yield arm.body((arm.scene.movable | arm.scene.fixtures)[target]).xyz
        return
    site = arm.data.site(target)
    mat, size = site.xmat.reshape(3, 3), np.asarray(sites[target].size, float)
    world = abs(mat @ size)  # as LIBERO has it
    middle = site.xpos.copy()
    offsets = [np.array([x * world[0], y * world[1], 0]) for x in SHARES for y in SHARES]
    yield from (middle + offset for offset in sorted(offsets, key=lambda each: abs(each).max()))


def _lowered(arm: Arm, body: int, pose: Pose) -> Pose | None:
    """Lower an object until it meets something; None if it meets nothing."""
    low, high = None, pose
    for fallen_m in np.arange(0, FALL_M, STEP_M):
        here = pose.shifted(np.array([0, 0, -fallen_m]))
        if _overlap_m(arm, body, here) < 0:
            low = here
            break
        high = here
    if low is None or low is pose:
        return None
    while high.xyz[2] - low.xyz[2] > EXACT_M:
        middle = Pose((high.xyz + low.xyz) / 2, pose.mat)
        if _overlap_m(arm, body, middle) < 0:
            low = middle
        else:
            high = middle
    _overlap_m(arm, body, low)
    return low


def _overlap_m(arm: Arm, body: int, pose: Pose) -> float:
    arm.place(body, pose)
    return arm.overlap_m(body)


def turned(pose: Pose, angle_rad: float) -> Pose:
    """Return an object's pose turned about the vertical."""
    return Pose(pose.xyz, rotation(np.array([0, 0, 1.0]), angle_rad) @ pose.mat)
