"""What goes into a policy and comes out of it: names, shapes, units; and the true state."""

from dataclasses import dataclass, field

import numpy as np

from lerobot_bomb.bomb.board import BOARD, NUM_STONES
from lerobot_bomb.bomb.episode import CONTROL_MODES, DEFAULT_FPS, Stage
from lerobot_bomb.flags import one_of

CAMERAS = ("workspace", "wrist")
RENDER_PRESETS = ("fast", "shadows")
DEFAULT_IMAGE_SIZE = 256  # pixels, square
MIN_IMAGE_SIZE, MAX_IMAGE_SIZE = 32, 1024
STATE_NAMES = ("x", "y", "z", "finger_opening")  # metres, world frame; opening = distance between the pads
ACTION_NAMES = {"relative": ("dx", "dy", "dz", "gripper"), "absolute": ("x", "y", "z", "gripper")}
STATE_DIM = len(STATE_NAMES)
ACTION_DIM = 4
MAX_STEP_M = 0.040  # metres that a relative action of 1 commands per control step
# Where the point between the pads' lower ends may be commanded, metres. World frame: origin on the table
# below the board's centre, x along columns, y towards the far row, z up.
WORKSPACE_LOW_M = (-0.13, -0.13, 0.006)
WORKSPACE_HIGH_M = (0.21, 0.13, 0.16)


@dataclass(frozen=True)
class RenderOptions:
    """What the cameras deliver; it changes the observation, never the physics."""

    image_size: int = DEFAULT_IMAGE_SIZE  # width and height in pixels
    preset: str = "fast"
    depth: bool = False  # deliver each camera's depth and geometry too; see `geometry_shapes`

    def __post_init__(self) -> None:
        one_of("--env.render_preset", self.preset, RENDER_PRESETS)
        if self.depth and self.preset != "fast":  # depth would be that of one of the 4 samples of a pixel
            raise ValueError(
                f"--env.depth=true needs --env.render_preset=fast (sharp edges), not {self.preset}"
            )
        if not MIN_IMAGE_SIZE <= self.image_size <= MAX_IMAGE_SIZE:
            raise ValueError(
                f"--env.image_size={self.image_size} must lie in {MIN_IMAGE_SIZE}..{MAX_IMAGE_SIZE} pixels"
            )


@dataclass(frozen=True)
class PrivilegedState:
    """The simulator's true state, which the expert reads and no trained policy sees."""

    gripper_xyz: np.ndarray  # (3,) metres, point between the pads' lower ends
    finger_opening: float  # metres between the pads
    target_xyz: np.ndarray  # (3,) metres, centre of a stone that rests on the target
    stone: int  # index of the stone to be moved
    stone_xyz: np.ndarray = field(repr=False)  # (NUM_STONES, 3) metres, centres
    stone_is_white: np.ndarray = field(repr=False)  # (NUM_STONES,) bool
    stone_in_play: np.ndarray = field(repr=False)  # (NUM_STONES,) bool; False: parked out of sight
    stage: Stage = Stage.START
    # how the environment reads actions
    control_mode: str = "relative"
    fps: int = DEFAULT_FPS
    stone_radius_m: float = BOARD.stone_radius_m
    max_opening_m: float = 0.044  # between the pads of open fingers
    # what the gripper has been told and, for latency, has not done yet: (3,) metres, and its command or 0
    pending_motion_m: np.ndarray = field(default_factory=lambda: np.zeros(3))
    pending_gripper: float = 0.0

    DIM = 3 + 1 + 3 + 4 + 2 + 4 + 5 * NUM_STONES

    def to_vector(self) -> np.ndarray:
        """(DIM,) float32, the observation ``environment_state``."""
        stones = np.concatenate(
            [self.stone_xyz, self.stone_is_white[:, None], self.stone_in_play[:, None]], axis=1
        )
        head = [
            *self.gripper_xyz,
            self.finger_opening,
            *self.target_xyz,
            self.stone,
            list(Stage).index(self.stage),
            CONTROL_MODES.index(self.control_mode),
            self.fps,
            self.stone_radius_m,
            self.max_opening_m,
            *self.pending_motion_m,
            self.pending_gripper,
        ]
        return np.concatenate([head, stones.ravel()]).astype(np.float32)

    @classmethod
    def from_vector(cls, vector: np.ndarray) -> "PrivilegedState":
        """Inverse of `to_vector`, in float64."""
        vector = np.asarray(vector, dtype=np.float64)
        if vector.shape != (cls.DIM,):
            raise ValueError(f"environment_state has shape {vector.shape}, expected ({cls.DIM},)")
        stones = vector[17:].reshape(NUM_STONES, 5)
        return cls(
            gripper_xyz=vector[0:3],
            finger_opening=float(vector[3]),
            target_xyz=vector[4:7],
            stone=int(vector[7]),
            stage=list(Stage)[int(vector[8])],
            control_mode=CONTROL_MODES[int(vector[9])],
            fps=int(vector[10]),
            stone_radius_m=float(vector[11]),
            max_opening_m=float(vector[12]),
            pending_motion_m=vector[13:16],
            pending_gripper=float(vector[16]),
            stone_xyz=stones[:, 0:3],
            stone_is_white=stones[:, 3] > 0.5,
            stone_in_play=stones[:, 4] > 0.5,
        )


def action_bounds(control_mode: str) -> tuple[np.ndarray, np.ndarray]:
    """(low, high), each (ACTION_DIM,) float32, of the action space in the environment's units."""
    if control_mode == "absolute":
        low, high = (*WORKSPACE_LOW_M, -1.0), (*WORKSPACE_HIGH_M, 1.0)
    else:
        low, high = (-1.0,) * ACTION_DIM, (1.0,) * ACTION_DIM
    return np.array(low, dtype=np.float32), np.array(high, dtype=np.float32)


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
