"""Objects that are put somewhere: taken, carried and let go, or dragged if they cannot be grasped."""

from collections.abc import Iterator, Sequence
from contextlib import suppress

import numpy as np

from lerobot_bomb.libero.episode import LiberoFailure
from lerobot_bomb.libero.expert import CLOSE
from lerobot_env_bomb.libero.expert.arm import BENT_RAD, CLOSED_M, Held, Pose
from lerobot_env_bomb.libero.expert.grasps import FINGER_M, MAX_POINTS, Grasp, grasps_of
from lerobot_env_bomb.libero.expert.motion import (
    ARRIVED,
    BACK_M,
    DOWN,
    KEPT_M,
    PASSING,
    PROGRESS_M,
    SETTLED_STEPS,
    UP,
    LostError,
    Motion,
    NextPose,
    NoPlanError,
    tilted,
)
from lerobot_env_bomb.libero.expert.paths import find_path, is_free_way
from lerobot_env_bomb.libero.expert.places import turned
from lerobot_env_bomb.libero.expert.surfaces import surface_of

TILTS_RAD = np.radians([25, 45]).tolist()  # of an approach, if none from above is free
MAX_TRIED = 400  # grasps
LOWEST_M = 0.0115  # of the point between the pads above what an object stands on
TURNS_RAD = np.radians([0, 30, -30, 60, -60, 90, -90, 135, -135, 180]).tolist()  # of an object in its place
# least bends of the elbow, the first that will do: a stretched arm is pushed past straight, and stays there
BENDS_RAD = (1.2, BENT_RAD)
LIFT_M = 0.05
ABOVE_M = 0.003  # a place, on arrival there
LOWER_M = 0.001  # a step, until the goal holds
HEIGHT_STEP_M = 0.005  # of height, over which an object is not drawn if there is another way
LEVEL_M = 0.015  # between the heights of an object and of a place to which it can be dragged
PRESS_M = 0.012  # how far a drag aims below the object's surface
AHEAD_M = 0.03  # how far it aims ahead
TOUCH_SHARES = (0.4, 0.0, 0.7, -0.4)  # of an object's half size from its middle towards its place
FINGERTIPS_M = 0.025


def choose_grasp(motion: Motion, body: int, places: Sequence[Pose]) -> Grasp:
    """Return the best free grasp of an object from which a place can be reached; after a loss, another one.

    Raises:
        NoPlanError: there is none.
    """
    first = motion.losses % len(BENDS_RAD)
    *bends_rad, last_rad = (*BENDS_RAD[first:], *BENDS_RAD[:first])
    for bent_rad in bends_rad:
        with motion.arm.keeping_bent(bent_rad), suppress(NoPlanError):
            return _choose_grasp(motion, body, places)
    with motion.arm.keeping_bent(last_rad):
        return _choose_grasp(motion, body, places)


def _choose_grasp(motion: Motion, body: int, places: Sequence[Pose]) -> Grasp:
    arm = motion.arm
    arm.mirror()
    surface = surface_of(arm.model, arm.data, arm.scene.geoms_of([body]))
    lowest_m = surface.points[:, 2].min() + LOWEST_M
    thing, mine, is_any_free, fitting = arm.body(body), arm.geoms([body]), False, []
    for approaches in ([DOWN], tilted(TILTS_RAD)):
        count = MAX_POINTS // len(approaches) + 40
        grasps = grasps_of(surface, motion.grip, approaches, lowest_m, count=count)
        for grasp in grasps[:MAX_TRIED]:
            if not motion.is_free(grasp, mine):
                continue
            is_any_free = True
            if _leads_to_place(motion, Held(body, grasp.pose.inverse @ thing), grasp.pose, places):
                fitting.append(grasp)
                if len(fitting) > motion.losses:
                    return grasp
        if fitting:
            return fitting[-1]
    raise NoPlanError(LiberoFailure.NO_PLACE if is_any_free else LiberoFailure.NO_GRASP)


def _leads_to_place(motion: Motion, held: Held, grip: Pose, places: Sequence[Pose]) -> bool:
    """Return True if a free place and a free path to it are found from a grasp."""
    pose = _gripper_at(motion, held, places)
    if pose is None:
        return False
    lifted = grip.shifted(-LIFT_M * grip.mat[:, 2])
    return find_path(motion.arm, pose.shifted(BACK_M * UP), held, CLOSED_M, lifted) is not None


def _gripper_at(motion: Motion, held: Held, places: Sequence[Pose]) -> Pose | None:
    """Return the pose of the gripper that puts what it holds into a place; None if none is free."""
    for place in places:
        for turn_rad in TURNS_RAD:
            pose = turned(place, turn_rad).shifted(ABOVE_M * UP) @ held.in_grip.inverse
            if is_free_way(motion.arm, [pose.shifted(BACK_M * UP), pose], held, CLOSED_M, KEPT_M):
                return pose
    return None


def carry(
    motion: Motion, goal: Sequence[str], body: int, places: Sequence[Pose], grasp: Grasp
) -> Iterator[NextPose]:
    """Carry what is held to a place, and let it go.

    An object that tilted in the grasp is set upright by the place that it is lowered onto, not in the air:
    near its base the arm cannot roll the gripper, and would lose its way.

    Raises:
        NoPlanError: no place or no path is free.
        LostError: it is not held any more.
    """
    arm = motion.arm
    geoms = arm.scene.geoms_of([body]).tolist()
    lifted = motion.grip.shifted(-LIFT_M * motion.grip.mat[:, 2])
    yield from motion.while_held(motion.go(lifted, CLOSE, PASSING, 0.6), geoms)
    arm.mirror()
    as_grasped = grasp.pose.mat.T @ places[0].mat
    held = Held(body, Pose((motion.grip.inverse @ arm.body(body)).xyz, as_grasped))
    for bent_rad in BENDS_RAD:
        with arm.keeping_bent(bent_rad):
            pose = _gripper_at(motion, held, places)
        if pose is not None:
            break
    else:
        raise NoPlanError(LiberoFailure.NO_PLACE)
    yield from motion.while_held(motion.go_along(pose.shifted(BACK_M * UP), held, CLOSE), geoms)
    yield from motion.go(pose, CLOSE, ARRIVED, 0.5)
    for _ in range(SETTLED_STEPS):
        if motion.task.holds(goal):
            break
        pose = pose.shifted(-LOWER_M * UP)
        yield NextPose(pose, CLOSE, 0.3)
    yield from motion.let_go()


def drag(motion: Motion, goal: Sequence[str], body: int, places: Sequence[Pose]) -> Iterator[NextPose]:
    """Press on an object from above, and draw it along what it lies on to the first of the most level places.

    Raises:
        NoPlanError: the place is at another height, or the gripper is not free at both ends.
        LostError: the object does not come along.
    """
    arm = motion.arm
    arm.mirror()
    here_m = arm.body(body).xyz[2]
    place = min(places, key=lambda each: round(abs(each.xyz[2] - here_m) / HEIGHT_STEP_M))
    touch = _touching(motion, body, place)
    yield from motion.go_along(touch.shifted(BACK_M * UP), None, CLOSE)
    pressed = touch.shifted(-PRESS_M * UP)
    yield from motion.go(pressed, CLOSE, (PRESS_M, ARRIVED[1]), 0.5)
    best, since = np.inf, 0
    while not motion.task.holds(goal):
        arm.mirror()
        left = (place.xyz - arm.body(body).xyz)[:2]
        left_m = float(np.linalg.norm(left))
        best, since = (left_m, 0) if left_m < best - PROGRESS_M else (best, since + 1)
        if since > SETTLED_STEPS:
            yield from motion.let_go()
            raise LostError
        ahead = motion.grip.xyz[:2] + left * min(1.0, AHEAD_M / left_m)
        yield NextPose(Pose(np.array([*ahead, pressed.xyz[2]]), pressed.mat), CLOSE)
    yield from motion.let_go()


def _touching(motion: Motion, body: int, place: Pose) -> Pose:
    """Return the pose of a closed gripper on top of an object, free here and at the place."""
    arm = motion.arm
    arm.mirror()
    thing, mine = arm.body(body), arm.geoms([body])
    points = surface_of(arm.model, arm.data, np.flatnonzero(mine)).points
    way = place.xyz - thing.xyz
    radius_m = np.ptp(points[:, :2], axis=0).max() / 2
    axis = np.cross(motion.grip.mat[:, 1], DOWN)
    axis /= np.linalg.norm(axis)
    mat = np.stack([axis, np.cross(DOWN, axis), DOWN], 1)
    for share in TOUCH_SHARES if abs(way[2]) < LEVEL_M else ():
        xy = thing.xyz[:2] + share * radius_m * way[:2] / np.linalg.norm(way)
        below = points[np.linalg.norm(points[:, :2] - xy, axis=1) < FINGERTIPS_M]
        if not len(below):
            continue
        pose = Pose(np.array([*xy, below[:, 2].max() + FINGER_M[1]]), mat)
        ends = [pose.shifted(BACK_M * UP), pose, pose.shifted(way)]
        if is_free_way(arm, ends, None, CLOSED_M, KEPT_M, mine):
            return pose
    raise NoPlanError(LiberoFailure.NO_GRASP)
