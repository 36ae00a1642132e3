"""Motions of the gripper: to poses, along free paths, around things and off them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_bomb.libero.episode import LiberoFailure
from lerobot_bomb.libero.expert import CLOSE, OPEN, angle_of
from lerobot_env_bomb.libero.expert.arm import CLOSED_M, OPEN_M, Arm, Held, Pose
from lerobot_env_bomb.libero.expert.grasps import Grasp
from lerobot_env_bomb.libero.expert.paths import find_path, is_free_way

UP = np.array([0.0, 0.0, 1.0])
DOWN = -UP
PASSING, ARRIVED = (0.025, 0.2), (0.006, 0.05)  # metres and radians
MAX_STEPS = 70  # to a pose
SETTLED_STEPS = 12  # without progress
PROGRESS_M = 0.001
CLOSE_STEPS, OPEN_STEPS = 20, 6
SQUEEZE_STEPS = 5  # after the first touch of both fingers, which does not hold a turn yet
BACK_M = 0.07  # before a grasp and after it
CLOSING_M = (0.03, 0.02, 0.01)  # of each finger, where nothing else may be between them
KEPT_M = 0.001  # between the gripper and everything, at a grasp or a place
LOST_STEPS = 3
AROUND_RAD = np.radians(np.arange(0, 360, 30))


class NoPlanError(Exception):
    """No grasp, place or path is free."""

    def __init__(self, failure: LiberoFailure):
        super().__init__(failure)
        self.failure = failure


class LostError(Exception):
    """The plan does not hold any more."""


@dataclass(frozen=True)
class NextPose:
    """Pose that the gripper goes to now."""

    pose: Pose
    gripper: float  # command, -1 to open
    speed: float = 1.0  # share of the highest


class Motion:
    """Motions of a scene's gripper, each an iterator over the targets of its steps."""

    def __init__(self, arm: Arm):
        self.arm, self.task = arm, arm.task
        self.losses = 0  # plans that did not hold

    @property
    def grip(self) -> Pose:
        """Pose of the gripper in the scene."""
        return self.arm.grip_of(self.arm.scene.data)

    def go(
        self, pose: Pose, gripper: float, tolerance: tuple[float, float], speed: float = 1.0
    ) -> Iterator[NextPose]:
        """Go straight, until the gripper is there or comes no nearer."""
        best, since = np.inf, 0
        for _ in range(MAX_STEPS):
            here = self.grip
            away_m = float(np.linalg.norm(pose.xyz - here.xyz))
            away_rad = angle_of(pose.mat @ here.mat.T)
            if away_m < tolerance[0] and away_rad < tolerance[1]:
                return
            left = away_m + 0.1 * away_rad
            best, since = (left, 0) if left < best - PROGRESS_M else (best, since + 1)
            if since > SETTLED_STEPS:
                return
            yield NextPose(pose, gripper, speed)

    def go_along(self, pose: Pose, held: Held | None, gripper: float) -> Iterator[NextPose]:
        """Go by a free path.

        Raises:
            NoPlanError: there is none.
        """
        corners = find_path(self.arm, pose, held, OPEN_M if held is None else CLOSED_M)
        if corners is None:
            raise NoPlanError(LiberoFailure.NO_PATH)
        for corner in corners:
            yield from self.go(corner, gripper, PASSING)

    def take(self, grasp: Grasp, geoms: Sequence[int]) -> Iterator[NextPose]:
        """Go to a grasp and close the gripper.

        Raises:
            NoPlanError: there is no free path.
            LostError: the fingers do not touch these geoms in the end.
        """
        yield from self.go_along(grasp.pose.shifted(-BACK_M * grasp.approach), None, OPEN)
        yield from self.go(grasp.pose, OPEN, ARRIVED, 0.6)
        gripped = 0
        for _ in range(CLOSE_STEPS):
            gripped = gripped + 1 if self.task.is_gripped(geoms) else 0
            if gripped > SQUEEZE_STEPS:
                break
            yield NextPose(grasp.pose, CLOSE)
        if not self.task.is_gripped(geoms):
            yield from self.let_go()
            raise LostError

    def let_go(self) -> Iterator[NextPose]:
        """Open the gripper and draw it back."""
        here = self.grip
        for _ in range(OPEN_STEPS):
            yield NextPose(here, OPEN)
        yield from self.go(here.shifted(-BACK_M * here.mat[:, 2]), OPEN, PASSING)

    def while_held(self, targets: Iterator[NextPose], geoms: Sequence[int]) -> Iterator[NextPose]:
        """Pass targets on while both fingers touch these geoms.

        Raises:
            LostError: they do not any more.
        """
        lost = 0
        for target in targets:
            lost = 0 if self.task.is_gripped(geoms) else lost + 1
            if lost > LOST_STEPS:
                raise LostError
            yield target

    def is_free(self, grasp: Grasp, is_grasped: np.ndarray) -> bool:
        """Return True if the open gripper comes straight to a grasp, and closes on nothing else.

        `is_grasped`: (geoms,) bool, what the fingers close on.
        """
        way = [grasp.pose.shifted(-back_m * grasp.approach) for back_m in (BACK_M, BACK_M / 2, 0.0)]
        if not is_free_way(self.arm, way, None, OPEN_M, KEPT_M):
            return False
        for opening_m in CLOSING_M:  # at the last pose of the way
            self.arm.set_fingers(opening_m)
            if self.arm.clearance_m(ignored=is_grasped) < KEPT_M:
                return False
        return True


def tilted(tilts_rad: Sequence[float]) -> list[np.ndarray]:
    """Return directions (3,) that are tilted from straight down, all around."""
    return [
        np.array([np.sin(tilt) * np.cos(around), np.sin(tilt) * np.sin(around), -np.cos(tilt)])
        for tilt in tilts_rad
        for around in AROUND_RAD.tolist()
    ]
