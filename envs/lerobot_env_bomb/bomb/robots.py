# pyright: reportAttributeAccessIssue=false, reportInvalidTypeForm=false
"""The arms that BOMB can be run with."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lerobot_bomb.bomb import so101
from lerobot_env_bomb.bomb.fetch import MAX_HALF_OPENING_M, fetch_joints, load_fetch
from lerobot_env_bomb.bomb.so101 import load_so101, so101_joints
from lerobot_env_bomb.shared.mujoco_gl import mujoco

SCARA_XML = Path(__file__).with_name("scara.xml")
BASE_XY = np.array([0.0, 0.30])  # metres, SCARA's shoulder; as in scara.xml
LINK_M = 0.27  # length of either of SCARA's links; as in scara.xml


@dataclass(frozen=True)
class Robot:
    """An arm with a parallel gripper whose fingers close along x.

    Its model holds the site `grip` between the pads' lower ends, drawn to the mocap body `command`; the
    camera `wrist`; and for each side a geom `left_pad`, a slide joint and a servo `left_finger`, whose
    position is 0 where the pads meet.
    """

    load: Callable[[], mujoco.MjSpec]  # the scene with this arm
    # gripper (3,) metres and half its opening -> its arm's joint positions
    joints: Callable[[np.ndarray, float], dict[str, float]]
    max_half_opening_m: float  # of one finger, so that open fingers clear a neighbouring stone


def load_scara() -> mujoco.MjSpec:
    """Load BOMB's scene with the SCARA arm."""
    return mujoco.MjSpec.from_file(str(SCARA_XML))


def scara_joints(gripper_xyz: np.ndarray, _half_opening_m: float) -> dict[str, float]:
    """Joint positions (radians, metres) that put SCARA's gripper at (3,) metres, elbow to the left."""
    reach = gripper_xyz[:2] - BASE_XY
    cosine = (reach @ reach) / (2 * LINK_M**2) - 1
    elbow = float(np.arccos(np.clip(cosine, -1, 1)))
    shoulder = float(np.arctan2(reach[1], reach[0])) - elbow / 2
    return {"shoulder": shoulder, "elbow": elbow, "lift": float(gripper_xyz[2]), "roll": -shoulder - elbow}


ROBOTS = {
    # outer faces of the fingers then clear a neighbour at one pitch by 5 mm
    "scara": Robot(load_scara, scara_joints, max_half_opening_m=0.022),
    "fetch": Robot(load_fetch, fetch_joints, MAX_HALF_OPENING_M),
    "so101": Robot(load_so101, so101_joints, so101.MAX_HALF_OPENING_M),
}
