"""The scripted expert's plan: goal after goal, and the pose that the gripper goes to next.

It keeps what a state does not show: the chosen grasp and path, and how far along them it is. After a loss it
plans anew.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from lerobot_bomb.libero.episode import LiberoFailure
from lerobot_bomb.libero.expert import MAX_MOTION_M, MAX_TURN_RAD, OPEN, LiberoState
from lerobot_bomb.libero.goals import expert_order
from lerobot_env_bomb.libero.expert.arm import Arm
from lerobot_env_bomb.libero.expert.motion import PASSING, LostError, Motion, NextPose, NoPlanError
from lerobot_env_bomb.libero.expert.objects import carry, choose_grasp, drag
from lerobot_env_bomb.libero.expert.parts import turn
from lerobot_env_bomb.libero.expert.places import resting_places
from lerobot_env_bomb.libero.scene import LiberoScene

HOME_M = 0.05  # nearer to where it began, the gripper is not drawn back for another plan


class Guide:
    """The expert's plan in one episode."""

    def __init__(self, scene: LiberoScene):
        self._motion = Motion(Arm(scene))
        self._home = self._motion.grip
        self._targets = self._plan()
        self.failure: LiberoFailure | None = None  # why there is no plan

    def state(self, pending: np.ndarray) -> LiberoState:
        """Return what the expert reads in the scene's present state; call it once a step.

        `pending`: (6,) motions that latency holds back.
        """
        target, grip = next(self._targets), self._motion.grip
        return LiberoState(
            grip.xyz, grip.mat, target.pose.xyz, target.pose.mat, target.gripper, target.speed,
            MAX_MOTION_M * pending[:3], MAX_TURN_RAD * pending[3:],
        )  # fmt: skip

    def _plan(self) -> Iterator[NextPose]:
        motion = self._motion
        while self.failure is None:
            try:
                yield from self._reach_next()
            except LostError:
                motion.losses += 1
            except NoPlanError as error:
                if np.linalg.norm(motion.grip.xyz - self._home.xyz) < HOME_M:
                    self.failure = error.failure
                yield from motion.go(self._home, OPEN, PASSING)
            yield NextPose(motion.grip, OPEN)
        while True:
            yield NextPose(motion.grip, OPEN)

    def _reach_next(self) -> Iterator[NextPose]:
        """Reach the first goal that does not hold."""
        task = self._motion.task
        goal = next((each for each in expert_order(task.goals) if not task.holds(each)), None)
        if goal is not None:
            yield from self._put(goal) if goal[0] in ("on", "in") else turn(self._motion, goal)

    def _put(self, goal: Sequence[str]) -> Iterator[NextPose]:
        """Put an object where a goal wants it, or open first what it goes into."""
        motion, arm = self._motion, self._motion.arm
        body = arm.scene.movable[goal[1]]
        places = resting_places(arm, goal, body)
        if not places:
            opening = motion.task.opening_of(goal[2])
            if opening is None or motion.task.holds(opening):
                raise NoPlanError(LiberoFailure.NO_PLACE)
            yield from turn(motion, opening, is_wide=True)
            return
        try:
            grasp = choose_grasp(motion, body, places)
        except NoPlanError as error:
            if error.failure != LiberoFailure.NO_GRASP:
                raise
            yield from drag(motion, goal, body, places)
        else:
            yield from motion.take(grasp, arm.scene.geoms_of([body]).tolist())
            yield from carry(motion, goal, body, places, grasp)
