# pyright: reportAttributeAccessIssue=false, reportInvalidTypeForm=false
"""PhysX, by SAPIEN, as a simulator of BOMB: bodies, masses and frictions are those of MuJoCo's model.

What has no counterpart:

- A stone's rim and its four feet are a cylinder, which PhysX lets rest flat.
- Elliptic cones, solref, solimp and impratio are left out: contacts are hard.
- Rolling and spinning friction are left out; the damping of a stone's joint is angular damping.
- The arm, drawn by a weld, is three slides, driven with the weld's frequency: no link of it touches anything.
- A servo's force limit includes its damping.
"""

from typing import Any

import numpy as np
import sapien
from sapien import Pose, physx

from lerobot_bomb.bomb.board import NUM_STONES
from lerobot_bomb.bomb.episode import PHYSICS_HZ
from lerobot_env_bomb.bomb.hand import PAD_SIDES
from lerobot_env_bomb.bomb.model import stone_name
from lerobot_env_bomb.bomb.physics import touched_stones
from lerobot_env_bomb.bomb.robots import Robot
from lerobot_env_bomb.shared.mujoco_gl import mujoco
from lerobot_env_bomb.shared.rotations import quaternion_of

SUPPORTS = ("table", "board", "tray")
TABLE_HALF_SIZE_M = (2.0, 2.0, 0.05)  # the box that stands for MuJoCo's plane
CONTACT_OFFSET_M = 0.002
POSITION_ITERATIONS, VELOCITY_ITERATIONS = 25, 2
HAND_MASS_KG = 0.5
HAND_RAD_S = 125.0  # frequency of the drive to the command: the weld's solref of 0.01 s and 0.8
# SAPIEN's cylinders and capsules lie along x, and its slides go along it
X_TO_X, X_TO_Y = (1.0, 0.0, 0.0, 0.0), (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
X_TO_Z, X_TO_MINUS_X = (np.sqrt(0.5), 0.0, -np.sqrt(0.5), 0.0), (0.0, 0.0, 0.0, 1.0)
PAD_GROUPS = [1, 1, 2, 0]  # the third number: pads do not touch each other


class SapienPhysics:
    """A PhysX scene of one episode, made anew by `begin`."""

    def __init__(self, robot: Robot, model: mujoco.MjModel, data: mujoco.MjData):
        self._robot, self._model, self._data = robot, model, data

    def begin(self) -> None:
        physx.set_scene_config(enable_enhanced_determinism=True)
        physx.set_shape_config(contact_offset=CONTACT_OFFSET_M)
        physx.set_body_config(POSITION_ITERATIONS, VELOCITY_ITERATIONS, sleep_threshold=0.0)
        self._system = physx.PhysxCpuSystem()
        self._system.timestep = 1 / PHYSICS_HZ
        self._scene = sapien.Scene([self._system])
        stone_friction = float(self._model.geom(stone_name(0)).friction[0])
        # PhysX takes the mean of two frictions; in MuJoCo the stone's counts
        self._material = physx.PhysxMaterial(stone_friction, stone_friction, 0.0)
        for name in SUPPORTS:
            self._add_support(name)
        in_play = [i for i in range(NUM_STONES) if self._model.geom(stone_name(i)).contype[0]]
        self._stones: dict[int, Any] = {i: self._add_stone(i) for i in in_play}
        self._add_hand()

    def _add_support(self, name: str) -> None:
        geom = self._model.geom(name)
        is_plane = geom.type[0] == mujoco.mjtGeom.mjGEOM_PLANE
        half_size = np.array(TABLE_HALF_SIZE_M) if is_plane else geom.size
        position = geom.pos - [0, 0, half_size[2]] if is_plane else geom.pos
        builder = self._scene.create_actor_builder()
        builder.add_box_collision(half_size=half_size.tolist(), material=self._material)
        builder.set_initial_pose(Pose(position))
        builder.build_static()

    def _add_stone(self, index: int) -> Any:
        name = stone_name(index)
        body, rim, joint = self._model.body(name), self._model.geom(name), self._model.joint(name)
        builder = self._scene.create_actor_builder()
        radius, half_height = rim.size[:2].tolist()
        builder.add_cylinder_collision(Pose(q=X_TO_Z), radius, half_height, self._material)
        builder.set_mass_and_inertia(float(body.mass[0]), Pose(), body.inertia.tolist())
        builder.set_initial_pose(Pose(self._data.joint(name).qpos[:3], self._data.joint(name).qpos[3:]))
        stone = builder.build(name).find_component_by_type(physx.PhysxRigidDynamicComponent)
        damping = self._model.dof_damping[joint.dofadr[0]]
        stone.linear_damping, stone.angular_damping = 0.0, float(damping / body.inertia.mean())
        return stone

    def _add_hand(self) -> None:
        """Add a hand on three slides, and its two fingers."""
        builder = self._scene.create_articulation_builder()
        link = builder.create_link_builder()
        link.set_mass_and_inertia(1.0, Pose(), [1.0, 1.0, 1.0])
        for axis, turn in zip("xyz", (X_TO_X, X_TO_Y, X_TO_Z), strict=True):
            link = self._add_slide(builder, link, axis, Pose(q=turn), (-np.inf, np.inf), HAND_MASS_KG)
        grip = self._data.site("grip").xpos
        for side in PAD_SIDES:
            joint, pad = self._model.joint(f"{side}_finger"), self._model.geom(f"{side}_pad")
            along = self._data.xaxis[joint.id]
            mass = float(self._model.body_mass[self._model.jnt_bodyid[joint.id]])
            turn = Pose(q=X_TO_X if along[0] > 0 else X_TO_MINUS_X)
            finger = self._add_slide(builder, link, f"{side}_finger", turn, tuple(joint.range), mass)
            opening = self._data.joint(f"{side}_finger").qpos[0]
            center = self._data.geom_xpos[pad.id] - grip - opening * along
            facing = quaternion_of(self._data.geom_xmat[pad.id])
            finger.add_box_collision(Pose(center, facing.tolist()), pad.size.tolist(), self._material)
        self._hand = builder.build(fix_root_link=True)
        joints = {joint.name: joint for joint in self._hand.active_joints}
        self._drives = [joints[axis] for axis in "xyz"]
        self._fingers = [joints[f"{side}_finger"] for side in PAD_SIDES]
        for drive in self._drives:
            drive.set_drive_properties(HAND_RAD_S**2, 2 * HAND_RAD_S, mode="acceleration")
        self._pads = []
        for finger in self._fingers:
            number = self._model.actuator(finger.name).id
            kp, limit = self._model.actuator_gainprm[number, 0], self._model.actuator_forcerange[number, 1]
            dof = self._model.joint(finger.name).dofadr[0]
            finger.set_drive_properties(float(kp), float(self._model.dof_damping[dof]), float(limit))
            finger.set_armature(np.array([self._model.dof_armature[dof]], dtype=np.float32))
            self._pads.append(finger.child_link)
        for each in self._hand.links:
            each.disable_gravity = True
            for shape in each.collision_shapes:
                shape.set_collision_groups(PAD_GROUPS)
        openings = [self._data.joint(finger.name).qpos[0] for finger in self._fingers]
        self._hand.qpos = np.array([*grip, *openings], dtype=np.float32)

    @staticmethod
    def _add_slide(builder: Any, parent: Any, name: str, along: Pose, limits: tuple, mass: float) -> Any:
        """Add a link that slides along the x-axis of a pose; return its builder."""
        link = builder.create_link_builder(parent)
        link.set_joint_name(name)
        link.set_joint_properties("prismatic", [limits], along, along)
        link.set_mass_and_inertia(mass, Pose(), [1e-3, 1e-3, 1e-3])
        return link

    def step(self, command_xyz: np.ndarray, opening_m: float) -> None:
        velocity = (command_xyz - self._data.mocap_pos[0]) * PHYSICS_HZ
        for drive, position, speed in zip(self._drives, command_xyz, velocity, strict=True):
            drive.set_drive_target(float(position))
            drive.set_drive_velocity_target(float(speed))
        for finger in self._fingers:
            finger.set_drive_target(opening_m)
        self._data.mocap_pos[0] = command_xyz
        self._system.step()

    def finish(self) -> None:
        *xyz, left, right = self._hand.qpos.astype(np.float64)
        joints = self._robot.joints(np.array(xyz), 0) | {"left_finger": left, "right_finger": right}
        for name, position in joints.items():
            self._data.joint(name).qpos = position
        for index, stone in self._stones.items():
            pose = stone.entity.pose
            self._data.joint(stone_name(index)).qpos = [*pose.p, *pose.q]
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)

    def touched(self) -> np.ndarray:
        pressed = (
            contact.bodies
            for contact in self._system.get_contacts()
            if any(np.any(point.impulse) for point in contact.points)
        )
        return touched_stones(pressed, self._pads, {stone: index for index, stone in self._stones.items()})
