"""Observations and actions of a policy: names, shapes, units."""

from dataclasses import dataclass

import numpy as np

from lerobot_bomb.bomb import so101
from lerobot_bomb.flags import one_of

# Keys of the environment's observation, as LeRobot's environments name them.
PIXELS = "pixels"  # {camera: (H, W, 3) uint8}
AGENT_POS = "agent_pos"  # float32, of `state_names`
ENVIRONMENT_STATE = "environment_state"  # PrivilegedState.to_vector()

CAMERAS = ("workspace", "wrist")
RENDER_PRESETS = ("fast", "shadows", "sapien")  # the first two: MuJoCo's renderer
DEFAULT_IMAGE_SIZE = 256  # pixels, square
MIN_IMAGE_SIZE, MAX_IMAGE_SIZE = 32, 1024
STATE_NAMES = ("x", "y", "z", "finger_opening")  # metres, world frame; opening = distance between the pads
# as LeRobot's driver of the arm names them; degrees, the last one percent
JOINT_NAMES = tuple(f"{joint}.pos" for joint in so101.JOINTS)
ACTION_NAMES = {
    "relative": ("dx", "dy", "dz", "gripper"),
    "absolute": ("x", "y", "z", "gripper"),
    "joints": JOINT_NAMES,
}
STATE_DIM = len(STATE_NAMES)  # not of control mode `joints`
ACTION_DIM = 4  # not of control mode `joints`
MAX_STEP_M = 0.040  # metres that a relative action of 1 commands per control step
MAX_STEP_DEG = 7.6  # that turn joints so far that the gripper moves by about MAX_STEP_M; the unit of noise
# Where the point between the pads' lower ends may be commanded, metres. World frame: origin on the table
# below the board's centre, x along columns, y towards the far row, z up.
WORKSPACE_LOW_M = (-0.13, -0.13, 0.006)
WORKSPACE_HIGH_M = (0.21, 0.13, 0.16)


@dataclass(frozen=True)
class RenderOptions:
    """Options of the cameras' images; they change the observation, never the physics."""

    image_size: int = DEFAULT_IMAGE_SIZE  # width and height in pixels
    preset: str = "fast"
    depth: bool = False  # deliver each camera's depth and geometry too; see `geometry_shapes`

    def __post_init__(self) -> None:
        one_of("--env.render_preset", self.preset, RENDER_PRESETS)
        if self.depth and self.preset == "shadows":  # depth would be that of one of the 4 samples of a pixel
            raise ValueError(
                f"--env.depth=true needs --env.render_preset=fast or sapien (sharp edges), not {self.preset}"
            )
        if not MIN_IMAGE_SIZE <= self.image_size <= MAX_IMAGE_SIZE:
            raise ValueError(
                f"--env.image_size={self.image_size} must lie in {MIN_IMAGE_SIZE}..{MAX_IMAGE_SIZE} pixels"
            )


def action_bounds(control_mode: str) -> tuple[np.ndarray, np.ndarray]:
    """(low, high), each (D,) float32, of the action space in the environment's units."""
    if control_mode == "joints":
        low, high = so101.to_driver(so101.LOW_RAD), so101.to_driver(so101.HIGH_RAD)
    elif control_mode == "absolute":
        low, high = (*WORKSPACE_LOW_M, -1.0), (*WORKSPACE_HIGH_M, 1.0)
    else:
        low, high = (-1.0,) * ACTION_DIM, (1.0,) * ACTION_DIM
    return np.array(low, dtype=np.float32), np.array(high, dtype=np.float32)


def state_names(control_mode: str) -> tuple[str, ...]:
    """Return the names of the numbers of the observed state."""
    return JOINT_NAMES if control_mode == "joints" else STATE_NAMES


def max_step(control_mode: str) -> float:
    """Return what noise of 1 adds to each number of an action but the gripper's."""
    return {"relative": 1.0, "absolute": MAX_STEP_M, "joints": MAX_STEP_DEG}[control_mode]


def reach_m(actions: np.ndarray, control_mode: str) -> np.ndarray:
    """Actions (T, D) in the environment's units -> (3,) metres, the point that they reach.

    Relative actions start at the gripper, others are in the world frame. Limits are ignored.
    """
    if control_mode == "joints":
        joints = so101.from_driver(actions[-1])
        return so101.grip_pose(joints, so101.jaw_half_opening_m(joints[-1]))[0]
    return actions[-1, :3] if control_mode == "absolute" else MAX_STEP_M * actions[:, :3].sum(axis=0)


def geometry_shapes(options: RenderOptions) -> dict[str, tuple[int, int]]:
    """Shape of each float32 array by its key in the environment's observation; {} without depth.

    ``depth.CAMERA`` (H, W): metres along the optical axis.
    ``intrinsics.CAMERA`` (3, 3): pixels of this image; the centre of the top left pixel is (0, 0).
    ``extrinsics.CAMERA`` (4, 4): world_from_camera in metres; camera axes x right, y down, z forward.
    """
    if not options.depth:
        return {}
    shapes = {"depth": (options.image_size, options.image_size), "intrinsics": (3, 3), "extrinsics": (4, 4)}
    return {f"{kind}.{camera}": shape for kind, shape in shapes.items() for camera in CAMERAS}
