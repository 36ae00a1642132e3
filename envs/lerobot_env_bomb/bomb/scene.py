# pyright: reportAttributeAccessIssue=false, reportInvalidTypeForm=false
"""Runs BOMB's model: put an episode's layout on the table, move the gripper, measure."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from lerobot_bomb.bomb import so101
from lerobot_bomb.bomb.board import NUM_STONES, Intersection
from lerobot_bomb.bomb.layout import Layout, SceneState
from lerobot_bomb.bomb.observation import WORKSPACE_HIGH_M, WORKSPACE_LOW_M
from lerobot_env_bomb.bomb.hand import PAD_SIDES
from lerobot_env_bomb.bomb.model import (
    NUM_FEET,
    STONE_RGBA,
    compile_scene,
    foot_name,
    parked_xyz,
    show_pattern,
    stone_name,
)
from lerobot_env_bomb.bomb.physics import MujocoPhysics, Physics
from lerobot_env_bomb.bomb.robots import ROBOTS, Robot
from lerobot_env_bomb.bomb.simulators import import_with_sapien
from lerobot_env_bomb.shared.mujoco_gl import mujoco
from lerobot_env_bomb.shared.rotations import quaternion_of

WORKSPACE_LOW = np.array(WORKSPACE_LOW_M)
WORKSPACE_HIGH = np.array(WORKSPACE_HIGH_M)

TRAVEL_SHARE = 0.7  # of a control step in which the command travels; the rest lets the arm settle

HIDDEN_RGBA = (0.0, 0.0, 0.0, 0.0)

type ModelEdit = Callable[[mujoco.MjModel], None]
# What edits may change; a reset undoes it.
EDITABLE = (
    *("body_inertia", "body_invweight0", "body_mass", "body_subtreemass", "bvh_aabb", "cam_fovy", "cam_pos"),
    *("cam_quat", "dof_invweight0", "geom_aabb", "geom_friction", "geom_matid", "geom_pos", "geom_rbound"),
    *("geom_rgba", "geom_size", "geom_type", "light_diffuse", "light_dir", "light_specular", "mat_rgba"),
    *("mat_shininess", "mat_specular"),
)


def physics_of(simulator: str) -> "Callable[[Robot, mujoco.MjModel, mujoco.MjData], Physics]":
    """Return the class of a simulator.

    Raises:
        ValueError: SAPIEN cannot be imported.
    """
    return MujocoPhysics if simulator == "mujoco" else import_with_sapien("sapien_physics").SapienPhysics


def _smooth(share: float) -> float:
    """Return the smoothstep of a share of the way: no jerk that would shake a held stone."""
    share = min(1.0, share)
    return 3 * share**2 - 2 * share**3


class Scene:
    """One compiled model and its state."""

    def __init__(self, robot: str = "scara", simulator: str = "mujoco"):
        self.robot = ROBOTS[robot]
        self.model = compile_scene(self.robot)
        self.data = mujoco.MjData(self.model)
        names = [stone_name(i) for i in range(NUM_STONES)]
        self._stone_bodies = np.array([self.model.body(name).id for name in names])
        self._stone_rims = np.array([self.model.geom(name).id for name in names])
        feet = [[self.model.geom(foot_name(i, k)).id for k in range(NUM_FEET)] for i in range(NUM_STONES)]
        self._stone_solids = np.column_stack([self._stone_rims, feet])
        self._contype, self._conaffinity = self.model.geom_contype.copy(), self.model.geom_conaffinity.copy()
        self._stone_visuals = np.array([self.model.geom(f"{name}_visual").id for name in names])
        self._stone_qpos = np.array([self.model.joint(name).qposadr[0] for name in names])
        self._fingers = np.array([self.model.joint(f"{side}_finger").qposadr[0] for side in PAD_SIDES])
        self._grip = self.model.site("grip").id
        headlight = self.model.vis.headlight
        arrays = [getattr(self.model, name) for name in EDITABLE] + [headlight.ambient, headlight.diffuse]
        self._nominal = [(array, array.copy()) for array in arrays]
        self._physics = physics_of(simulator)(self.robot, self.model, self.data)

    def reset(
        self,
        layout: Layout,
        edits: Sequence[ModelEdit] = (),
        pattern: Mapping[Intersection, str] | None = None,
    ) -> None:
        """Start at rest from the layout, with open fingers, in a model with only these edits.

        `pattern`: shown on the small board in the tray; without it there is no such board.
        """
        mujoco.mj_resetData(self.model, self.data)
        for array, nominal in self._nominal:
            array[...] = nominal
        self._show_stones(layout)
        if pattern:
            show_pattern(self.model, pattern)
        for edit in edits:
            edit(self.model)
        for i, adr in enumerate(self._stone_qpos):
            xyz = [*layout.stone_xy[i], layout.rest_height_m] if layout.stone_in_play[i] else parked_xyz(i)
            self.data.qpos[adr : adr + 7] = [*xyz, 1, 0, 0, 0]
        self.data.mocap_pos[0] = layout.gripper_xyz
        self._set_arm(self.robot.max_half_opening_m)
        self.data.ctrl[:] = self.robot.max_half_opening_m
        mujoco.mj_forward(self.model, self.data)
        self._physics.begin()

    def hold(self, stone: int, stone_xyz: np.ndarray, opening_m: float) -> None:
        """Put a stone with its centre at (3,) metres between pads that are ``opening_m`` apart."""
        adr = self._stone_qpos[stone]
        self.data.qpos[adr : adr + 3] = stone_xyz
        self._set_arm(opening_m / 2)
        mujoco.mj_forward(self.model, self.data)

    def move(self, target_xyz: np.ndarray, open_fingers: bool, num_substeps: int) -> None:
        """Move the gripper towards (3,) metres, clipped to the workspace, and open or close it."""
        start = self.data.mocap_pos[0].copy()
        target = np.clip(target_xyz, WORKSPACE_LOW, WORKSPACE_HIGH)
        opening_m = self.robot.max_half_opening_m if open_fingers else 0.0
        num_travel = max(1, round(TRAVEL_SHARE * num_substeps))
        for substep in range(num_substeps):
            self._physics.step(start + _smooth((substep + 1) / num_travel) * (target - start), opening_m)
        self._physics.finish()

    def move_joints(self, target: np.ndarray, num_substeps: int) -> None:
        """Move SO-101's joints to (6,) radians; stones and board may hold them off."""
        start, self._joints = self._joints, target
        num_travel = max(1, round(TRAVEL_SHARE * num_substeps))
        for substep in range(num_substeps):
            joints = start + _smooth((substep + 1) / num_travel) * (target - start)
            xyz, rotation = so101.grip_pose(joints, float(self.data.qpos[self._fingers[0]]))
            self.data.mocap_quat[0] = quaternion_of(rotation)
            self._physics.step(xyz, so101.jaw_half_opening_m(joints[-1]))
        self._physics.finish()

    def joints(self) -> np.ndarray:
        """Return the measured positions of the robot's joints."""
        return np.array([self.data.joint(name).qpos[0] for name in self._joint_names])

    def measure(self) -> SceneState:
        """Return the current poses and contacts."""
        return SceneState(
            gripper_xyz=self.data.site_xpos[self._grip].copy(),
            finger_opening=float(self.data.qpos[self._fingers].sum()),
            stone_xyz=self.data.xpos[self._stone_bodies].copy(),
            stone_touched=self._physics.touched(),
        )

    def _set_arm(self, half_opening_m: float) -> None:
        """Put arm and fingers where the command is."""
        joints = self.robot.joints(self.data.mocap_pos[0], half_opening_m)
        for joint, value in joints.items():
            self.data.joint(joint).qpos = value
        self._joint_names, self._joints = tuple(joints), np.array(list(joints.values()))
        self.data.qpos[self._fingers] = half_opening_m

    def _show_stones(self, layout: Layout) -> None:
        """Colour the stones in play; hide the others and take contact and weight from them."""
        for i in range(NUM_STONES):
            in_play = bool(layout.stone_in_play[i])
            rgba = STONE_RGBA[bool(layout.stone_is_white[i])] if in_play else HIDDEN_RGBA
            self.model.geom_rgba[self._stone_visuals[i]] = rgba
            solids = self._stone_solids[i]
            self.model.geom_contype[solids] = self._contype[solids] * in_play
            self.model.geom_conaffinity[solids] = self._conaffinity[solids] * in_play
            self.model.body_gravcomp[self._stone_bodies[i]] = not in_play
