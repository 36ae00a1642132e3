# pyright: reportAttributeAccessIssue=false
"""Doors, drawers and knobs: the joint that a goal is about, grasped and moved until the goal holds."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_bomb.libero.episode import LiberoFailure
from lerobot_bomb.libero.expert import CLOSE
from lerobot_env_bomb.libero.expert.arm import CLOSED_M, Arm, Pose
from lerobot_env_bomb.libero.expert.grasps import Grasp, grasps_of
from lerobot_env_bomb.libero.expert.motion import (
    DOWN,
    KEPT_M,
    SETTLED_STEPS,
    LostError,
    Motion,
    NextPose,
    NoPlanError,
    tilted,
)
from lerobot_env_bomb.libero.expert.surfaces import surface_of
from lerobot_env_bomb.libero.stock import mujoco

COUNT = 60  # positions of a joint that are tried
BEYOND = 0.06  # of the joint's range, that a goal is passed by
REACHED = 0.03  # of it, from the target
PROGRESS = 0.005  # of it, in a step
LEAD = 0.25  # of it, that the gripper is ahead of a part
TILTS_RAD = np.radians([55, 90]).tolist()  # of an approach, beside straight down
ROLLS_RAD = (0.0, 0.6, -0.6)  # of the gripper about its approach
MAX_POINTS = 60
SHARES = (0.5, 1.0)  # of the way of a part, where the arm is looked at


@dataclass(frozen=True)
class MovingPart:
    """A moving part of a fixture."""

    joint: int
    body: int
    target: float  # position of the joint, radians or metres
    geoms: np.ndarray  # indices of its geometry and that of what hangs on it

    def position(self, model: "mujoco.MjModel", data: "mujoco.MjData") -> float:
        """Position of the joint."""
        return float(data.qpos[model.jnt_qposadr[self.joint]])

    def pose_at(self, arm: Arm, position: float) -> Pose:
        """Pose of the part with its joint at a position; the arm's copy is left so."""
        arm.data.qpos[arm.model.jnt_qposadr[self.joint]] = position
        mujoco.mj_kinematics(arm.model, arm.data)
        return arm.body(self.body)


def turn(motion: Motion, goal: Sequence[str], is_wide: bool = False) -> Iterator[NextPose]:
    """Move a fixture's part until a goal holds; `is_wide`: as far as its joint goes.

    Raises:
        NoPlanError: no grasp or no path is free.
        LostError: the part does not move as far.
    """
    part = part_of(motion.arm, goal, is_wide)
    if part is None:
        raise NoPlanError(LiberoFailure.NO_GRASP)
    yield from motion.take(_choose_grasp(motion, part), part.geoms.tolist())
    yield from _move(motion, part)
    yield from motion.let_go()
    if not motion.task.holds(goal):
        raise LostError


def part_of(arm: Arm, goal: Sequence[str], is_wide: bool) -> MovingPart | None:
    """Return the part that a goal moves; None if no position of a joint fulfils it."""
    for name in arm.task.joints_of(goal[1]):
        joint = arm.model.joint(name).id
        target = _target(arm, goal, joint, is_wide)
        if target is not None:
            body = int(arm.model.jnt_bodyid[joint])
            return MovingPart(joint, body, target, _geoms_on(arm, body))
    return None


def _target(arm: Arm, goal: Sequence[str], joint: int, is_wide: bool) -> float | None:
    """Return the position of a joint to aim at, a little beyond the nearest that fulfils a goal."""
    arm.mirror()
    address = arm.model.jnt_qposadr[joint]
    now, ends = float(arm.data.qpos[address]), arm.model.jnt_range[joint]
    beyond = BEYOND * float(np.ptp(ends))
    found = []
    for end in ends.tolist():
        for position in np.linspace(now, end, COUNT).tolist():
            arm.data.qpos[address] = position
            if arm.task.holds(goal, arm.data):
                aim = end if is_wide else position + np.clip(end - position, -beyond, beyond)
                found.append((abs(position - now), float(aim)))
                break
    arm.mirror()
    return min(found)[1] if found else None


def _geoms_on(arm: Arm, body: int) -> np.ndarray:
    model = arm.model
    is_on = np.zeros(model.nbody, bool)
    for each in range(body, model.nbody):  # parents come before their children
        is_on[each] = each == body or is_on[model.body_parentid[each]]
    return np.flatnonzero(is_on[model.geom_bodyid])


def _choose_grasp(motion: Motion, part: MovingPart) -> Grasp:
    """Return the best free grasp with which the arm can follow the part; after a loss, another one."""
    arm, fitting = motion.arm, []
    arm.mirror()
    surface = surface_of(arm.model, arm.data, part.geoms)
    start, now = arm.body(part.body), part.position(arm.model, arm.data)
    positions = [now + share * (part.target - now) for share in SHARES]
    poses = [part.pose_at(arm, position) for position in positions]
    mine = np.isin(np.arange(arm.model.ngeom), part.geoms)
    grasps = grasps_of(
        surface, motion.grip, [DOWN, *tilted(TILTS_RAD)],
        offsets=(0.0,), rolls=ROLLS_RAD, count=MAX_POINTS,
    )  # fmt: skip
    for grasp in grasps:
        in_part = start.inverse @ grasp.pose
        if motion.is_free(grasp, mine) and all(
            _can_hold(arm, part, mine, position, pose @ in_part)
            for position, pose in zip(positions, poses, strict=True)
        ):
            fitting.append(grasp)
            if len(fitting) > motion.losses:
                return grasp
    if fitting:
        return fitting[-1]
    raise NoPlanError(LiberoFailure.NO_GRASP)


def _can_hold(arm: Arm, part: MovingPart, mine: np.ndarray, position: float, pose: Pose) -> bool:
    """Return True if the arm touches only the part's own geoms at a pose, while the part is at a position."""
    arm.mirror()
    joints = arm.joints
    part.pose_at(arm, position)
    if not arm.reach(pose, joints, arm.rest):
        return False
    arm.set_fingers(CLOSED_M)
    return arm.clearance_m(ignored=mine) >= KEPT_M


def _move(motion: Motion, part: MovingPart) -> Iterator[NextPose]:
    """Move the gripper as the part moves, until the part is at its target or comes no nearer."""
    arm = motion.arm
    model, data = arm.scene.model, arm.scene.data
    arm.mirror()
    in_part = arm.body(part.body).inverse @ motion.grip
    span = float(np.ptp(model.jnt_range[part.joint]))
    best, since = np.inf, 0
    while since < 2 * SETTLED_STEPS:
        now = part.position(model, data)
        left = part.target - now
        if abs(left) < REACHED * span:
            return
        best, since = (abs(left), 0) if abs(left) < best - PROGRESS * span else (best, since + 1)
        arm.mirror()
        step = float(np.clip(left, -LEAD * span, LEAD * span))
        yield NextPose(part.pose_at(arm, now + step) @ in_part, CLOSE)
