# pyright: reportAttributeAccessIssue=false, reportInvalidTypeForm=false
"""The Fetch arm, from the installed gymnasium-robotics, in BOMB's scene.

Its model is read at run time and changed here: the arm stands behind the board, driven like SCARA through
the mocap body `command`, and its fingers get SCARA's servos.
"""

from pathlib import Path

import numpy as np

from lerobot_env_bomb.bomb.arm_files import arm_xml
from lerobot_env_bomb.bomb.hand import PAD_SIDES, weld_to_command
from lerobot_env_bomb.shared.mujoco_gl import mujoco

SCENE_XML = Path(__file__).with_name("scene.xml")

MAX_HALF_OPENING_M = 0.0165  # of one finger; outer faces then clear a neighbour at one pitch by 1.5 mm

PREFIX = "robot0:"  # of all names in Fetch's model
TORSO_XYZ = (0.04, 0.7095, 0.03)  # metres, where the torso stands; it looks at the board, towards -y
TORSO_QUAT = (np.sqrt(0.5), 0.0, 0.0, -np.sqrt(0.5))
# Bodies that no camera of ours sees; rolls are held still, which leaves the other five joints one solution.
LEFT_OUT_BODIES = ("head_pan_link", "gripper_camera_link")
LEFT_OUT_JOINTS = ("torso_lift_joint", "upperarm_roll_joint", "forearm_roll_joint")

# Lengths of Fetch's arm, metres; as in its model
PAN_XY = np.array([TORSO_XYZ[0], TORSO_XYZ[1] - 0.1195])  # the shoulder's vertical axis, in the world
SHOULDER_OFFSET_M = 0.117  # from there to the axis that lifts the arm
SHOULDER_HEIGHT_M = TORSO_XYZ[2] + 0.3486 + 0.06  # of that axis above the table
UPPER_ARM_M = 0.352
FOREARM_M = 0.3215
FINGERTIP_X_M = 0.0385  # in the gripper's frame, whose x points out of the hand
HAND_M = 0.1385 + 0.1664 + FINGERTIP_X_M  # from the wrist's axis to the fingers' ends

CAMERA_XYZ = (0.0, -0.080, 0.105)  # metres from the grip point, world axes: in front of the palm
CAMERA_TILT_RAD = np.deg2rad(32)  # from straight down towards the fingers

JOINT_DAMPING, JOINT_ARMATURE = 0.5, 0.2  # N m s/rad, kg m^2; with less, the hand tilts when it brakes
# Fetch's fingers weigh 4 kg each, which SCARA's light servos could not hold against the arm's motion.
FINGER_MASS_KG = 0.015
FINGER_INERTIA = (5e-6, 1e-5, 1e-5)  # kg m^2


def load_fetch() -> mujoco.MjSpec:
    """Load BOMB's scene with the Fetch arm."""
    fetch = mujoco.MjSpec.from_file(str(arm_xml("fetch")))
    for name in LEFT_OUT_BODIES:
        fetch.delete(fetch.body(PREFIX + name))
    for name in LEFT_OUT_JOINTS:
        fetch.delete(fetch.joint(PREFIX + name))
    spec = mujoco.MjSpec.from_file(str(SCENE_XML))
    torso = spec.worldbody.add_frame().attach_body(fetch.body(f"{PREFIX}torso_lift_link"), "", "")
    torso.pos, torso.quat = TORSO_XYZ, TORSO_QUAT
    for body in [torso, *torso.find_all("body")]:
        body.gravcomp = 1
    for geom in torso.find_all("geom"):
        geom.contype = geom.conaffinity = 0
    for joint in torso.find_all("joint"):
        joint.damping[0], joint.armature = JOINT_DAMPING, JOINT_ARMATURE  # damping: a polynomial's terms
    _add_hand(spec, spec.body(f"{PREFIX}gripper_link"))
    for side, outwards in zip(PAD_SIDES, (-1, 1), strict=True):
        _replace_servo(spec, side, spec.body(f"{PREFIX}{side[0]}_gripper_finger_link"), outwards)
    return spec


def fetch_joints(gripper_xyz: np.ndarray, _half_opening_m: float) -> dict[str, float]:
    """Joint positions (radians) that put the gripper at (3,) metres, pointing down, elbow up."""
    offset = gripper_xyz[:2] - PAN_XY
    pan = float(np.arctan2(offset[0], -offset[1]))
    # the wrist's axis in the arm's vertical plane, from the shoulder: outwards, downwards
    outwards = float(np.linalg.norm(offset)) - SHOULDER_OFFSET_M
    downwards = SHOULDER_HEIGHT_M - HAND_M - float(gripper_xyz[2])
    cosine = (outwards**2 + downwards**2 - UPPER_ARM_M**2 - FOREARM_M**2) / (2 * UPPER_ARM_M * FOREARM_M)
    elbow = float(np.arccos(np.clip(cosine, -1, 1)))
    lift = float(
        np.arctan2(downwards, outwards)
        - np.arctan2(FOREARM_M * np.sin(elbow), UPPER_ARM_M + FOREARM_M * np.cos(elbow))
    )
    joints = {
        "shoulder_pan": pan,
        "shoulder_lift": lift,
        "elbow_flex": elbow,
        "wrist_flex": np.pi / 2 - lift - elbow,
        "wrist_roll": pan,
    }
    return {f"{PREFIX}{name}_joint": angle for name, angle in joints.items()}


def _add_hand(spec: mujoco.MjSpec, gripper: mujoco.MjsBody) -> None:
    """Add grip point, wrist camera and the weld that drives them."""
    # The gripper's x points down, its y along the world's x, its z towards the viewer: -y.
    world_in_gripper = [0.5, -0.5, -0.5, 0.5]
    weld_to_command(spec, gripper, pos=[FINGERTIP_X_M, 0, 0], quat=world_in_gripper)
    hand = gripper.add_frame(pos=[FINGERTIP_X_M, 0, 0], quat=world_in_gripper)
    tilt = [np.cos(CAMERA_TILT_RAD / 2), np.sin(CAMERA_TILT_RAD / 2), 0, 0]
    gripper.add_camera(name="wrist", pos=CAMERA_XYZ, quat=tilt, fovy=52).set_frame(hand)


def _replace_servo(spec: mujoco.MjSpec, side: str, finger: mujoco.MjsBody, outwards: int) -> None:
    """Give a finger SCARA's servo and contacts; `outwards` is the sign of its way along y."""
    pad, scara_pad = finger.geoms[0], spec.find_default("pad").geom
    pad.name = f"{side}_pad"
    pad.contype, pad.conaffinity, pad.margin = scara_pad.contype, scara_pad.conaffinity, 0
    finger.mass, finger.inertia = FINGER_MASS_KG, FINGER_INERTIA
    finger.pos = [0, outwards * pad.size[1] - pad.pos[1], 0]  # closed pads meet in the middle
    spec.delete(finger.joints[0])
    name, travel_m, servo = f"{side}_finger", [0, MAX_HALF_OPENING_M], spec.find_default("finger")
    finger.add_joint(servo, name=name, axis=[0, outwards, 0], range=travel_m)
    joint = mujoco.mjtTrn.mjTRN_JOINT
    spec.add_actuator(servo, name=name, target=name, trntype=joint, ctrlrange=travel_m)
