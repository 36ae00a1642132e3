# pyright: reportAttributeAccessIssue=false
"""The arm in a copy of the scene: posed by inverse kinematics, and asked how near it is to things."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass

import numpy as np

from lerobot_bomb.libero.expert import rotation_vector
from lerobot_env_bomb.libero.expert.task import LiberoTask
from lerobot_env_bomb.libero.scene import ROBOT_PREFIXES, LiberoScene
from lerobot_env_bomb.libero.stock import mujoco
from lerobot_env_bomb.shared.rotations import quaternion_of

GRIP = "gripper0_grip_site"  # between the pads; the controller moves it
FINGER_JOINTS = ("gripper0_finger_joint1", "gripper0_finger_joint2")
OPEN_M, CLOSED_M = 0.04, 0.0  # of each finger from the middle
SIGHT_M = 0.012  # distances beyond count as this
MAX_ITERATIONS = 60
DAMPING = 0.02
MAX_TURN_RAD = 0.25  # of a joint in an iteration
REACHED = (0.002, 0.02)  # metres and radians
LIMIT_RAD = 0.05  # that joints keep from their limits
ELBOW, BENT_RAD = 3, 0.95  # a joint, and what it keeps from straight: near there the arm leaves its way


@dataclass(frozen=True)
class Pose:
    """Position and orientation of the gripper, or of a body."""

    xyz: np.ndarray  # (3,) metres
    mat: np.ndarray  # (3, 3) rotation

    def __matmul__(self, other: "Pose") -> "Pose":
        return Pose(self.xyz + self.mat @ other.xyz, self.mat @ other.mat)

    @property
    def inverse(self) -> "Pose":
        return Pose(-self.mat.T @ self.xyz, self.mat.T)

    def shifted(self, offset: np.ndarray) -> "Pose":
        """Return the pose moved by (3,) metres in the world."""
        return Pose(self.xyz + offset, self.mat)


@dataclass(frozen=True)
class Held:
    """An object in the gripper: where it is in the gripper's frame."""

    body: int
    in_grip: Pose


class Arm:
    """A copy of the scene's model and state; nothing done here changes the scene."""

    def __init__(self, scene: LiberoScene):
        self.scene, self.task = scene, LiberoTask(scene)
        self.model = copy(scene.model)
        self.data = mujoco.MjData(self.model)
        bodies = [self.model.body(body).name for body in range(self.model.nbody)]
        self.is_robot = np.array([name.startswith(ROBOT_PREFIXES) for name in bodies])[self.model.geom_bodyid]
        self.model.geom_margin[self.is_robot] = SIGHT_M
        joints = scene.joints_of_robot()
        self._qpos = joints
        self._dofs = np.array([self.model.jnt_dofadr[self._joint_at(address)] for address in joints])
        limits = np.array([self.model.jnt_range[self._joint_at(address)] for address in joints])
        self._low, self._high = limits[:, 0] + LIMIT_RAD, limits[:, 1] - LIMIT_RAD
        self._high[ELBOW] = -BENT_RAD
        self._fingers = [int(self.model.joint(name).qposadr[0]) for name in FINGER_JOINTS]
        self._site = self.model.site(GRIP).id
        self.rest = self.task.resting_joints()
        self.mirror()

    def _joint_at(self, address: int) -> int:
        return int(np.flatnonzero(self.model.jnt_qposadr == address)[0])

    def mirror(self) -> None:
        """Copy the scene's state."""
        self.data.qpos[:] = self.scene.data.qpos
        self._update()

    def grip_of(self, data: "mujoco.MjData") -> Pose:
        """Pose of the gripper in a state of this scene."""
        return Pose(data.site_xpos[self._site].copy(), data.site_xmat[self._site].reshape(3, 3).copy())

    @property
    def grip(self) -> Pose:
        """Pose of the gripper."""
        return self.grip_of(self.data)

    def body(self, body: int) -> Pose:
        """Pose of a body."""
        return Pose(self.data.xpos[body].copy(), self.data.xmat[body].reshape(3, 3).copy())

    @property
    def joints(self) -> np.ndarray:
        """(7,) radians."""
        return self.data.qpos[self._qpos].copy()

    @contextmanager
    def keeping_bent(self, bent_rad: float) -> Iterator[None]:
        """Let the elbow keep this from straight, in radians."""
        usual, self._high[ELBOW] = self._high[ELBOW], -bent_rad
        try:
            yield
        finally:
            self._high[ELBOW] = usual

    def reach(self, pose: Pose, *starts: np.ndarray) -> bool:
        """Bring the gripper to a pose, from one of these joints on; False if it cannot be reached."""
        return any(self._reach(pose, joints) for joints in starts)

    def _reach(self, pose: Pose, joints: np.ndarray) -> bool:
        self.data.qpos[self._qpos] = joints
        jacobian = np.zeros((6, self.model.nv))
        for _ in range(MAX_ITERATIONS):
            mujoco.mj_kinematics(self.model, self.data)
            mujoco.mj_comPos(self.model, self.data)
            now = self.grip
            error = np.concatenate([pose.xyz - now.xyz, rotation_vector(pose.mat @ now.mat.T)])
            if np.linalg.norm(error[:3]) < REACHED[0] and np.linalg.norm(error[3:]) < REACHED[1]:
                return True
            mujoco.mj_jacSite(self.model, self.data, jacobian[:3], jacobian[3:], self._site)
            some = jacobian[:, self._dofs]
            inverse = some.T @ np.linalg.inv(some @ some.T + DAMPING**2 * np.eye(6))
            turn = inverse @ error
            rest = self.rest - self.data.qpos[self._qpos]
            turn += 0.1 * (rest - inverse @ (some @ rest))
            turn *= min(1.0, MAX_TURN_RAD / max(abs(turn).max(), 1e-9))
            qpos = self.data.qpos[self._qpos] + turn
            self.data.qpos[self._qpos] = np.clip(qpos, self._low, self._high)
        return False

    def set_fingers(self, opening_m: float) -> None:
        """Move each finger this far from the middle."""
        for address, sign in zip(self._fingers, (1, -1), strict=True):
            self.data.qpos[address] = sign * opening_m

    def place(self, body: int, pose: Pose) -> None:
        """Move a free object."""
        address = int(self.model.jnt_qposadr[self.model.body_jntadr[body]])
        self.data.qpos[address : address + 7] = np.concatenate([pose.xyz, quaternion_of(pose.mat)])

    def hold(self, held: Held | None) -> None:
        """Move what is held to where the gripper has it now."""
        if held is not None:
            mujoco.mj_kinematics(self.model, self.data)
            self.place(held.body, self.grip @ held.in_grip)

    def geoms(self, bodies: Iterable[int]) -> np.ndarray:
        """(geoms,) bool, those of objects or fixtures."""
        return np.isin(self.scene.owners[self.model.geom_bodyid], list(bodies))

    def clearance_m(self, held: Held | None = None, ignored: np.ndarray | None = None) -> float:
        """Distance from robot and held object to the nearest other thing; negative: they overlap."""
        self._update()
        moving = self.is_robot.copy()
        if held is not None:
            moving |= self.geoms([held.body])
        pairs = self.data.contact.geom
        if not len(pairs):
            return SIGHT_M
        is_pair = moving[pairs[:, 0]] != moving[pairs[:, 1]]
        if ignored is not None:
            is_pair &= ~(ignored[pairs[:, 0]] | ignored[pairs[:, 1]])
        distances = self.data.contact.dist[is_pair]
        return float(distances.min()) if len(distances) else SIGHT_M

    def overlap_m(self, body: int) -> float:
        """Distance from an object to what it touches, apart from the robot; 0 if nothing."""
        self._update()
        mine, pairs = self.geoms([body]), self.data.contact.geom
        if not len(pairs):
            return 0.0
        is_pair = (mine[pairs[:, 0]] != mine[pairs[:, 1]]) & ~self.is_robot[pairs].any(1)
        distances = self.data.contact.dist[is_pair]
        return float(distances.min()) if len(distances) else 0.0

    def _update(self) -> None:
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_collision(self.model, self.data)
