"""The one definition of names, shapes and records that BOMB's parts exchange.

numpy only: simulator workers import this module and must start in under a second.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from lerobot_bomb.flags import one_of
from lerobot_bomb.perturbations import NONE, Condition

# Version of task, physics, observation and success rule: what a recording is of, and its robot type says.
TASK_VERSION = "1.0"
# Version of how a policy is measured and what a line of results says. 1.1 is the task of 1.0 with lines that
# name simulator, policy and tasks.
PROTOCOL_VERSION = "1.1"

SUITES = ("place",)
ROBOTS = ("scara", "fetch")
CONTROL_MODES = ("relative", "absolute")
SPLITS = ("all", "train", "heldout")
RENDER_PRESETS = ("fast", "shadows")
CAMERAS = ("workspace", "wrist")
COLORS = ("black", "white")

DEFAULT_FPS = 10  # control steps per second
PHYSICS_HZ = 200  # physics steps per second; a multiple of the control rate
DEFAULT_IMAGE_SIZE = 256  # pixels, square
MIN_IMAGE_SIZE, MAX_IMAGE_SIZE = 32, 1024
MAX_EPISODE_STEPS = {"place": 100}  # at DEFAULT_FPS; scaled with fps

STATE_NAMES = ("x", "y", "z", "finger_opening")  # metres, world frame; opening = distance between the pads
ACTION_NAMES = {"relative": ("dx", "dy", "dz", "gripper"), "absolute": ("x", "y", "z", "gripper")}
STATE_DIM = len(STATE_NAMES)
ACTION_DIM = 4
MAX_STEP_M = 0.040  # metres that a relative action of 1 commands per control step

# Where the point between the pads' lower ends may be commanded, metres. World frame: origin on the table
# below the board's centre, x along columns, y towards the far row, z up.
WORKSPACE_LOW_M = (-0.13, -0.13, 0.006)
WORKSPACE_HIGH_M = (0.21, 0.13, 0.16)

MAX_SEED = 2**32 - 1  # what LeRobot seeds NumPy with

NUM_STONES = 12  # stones in the compiled model: on the board, to be moved, or parked out of sight


@dataclass(frozen=True)
class BoardGeometry:
    """Sizes of board and stones in metres. Row 0 is the far row (+y), columns run along +x."""

    num_lines: int = 5
    pitch_m: float = 0.045
    margin_m: float = 0.035
    thickness_m: float = 0.005
    stone_radius_m: float = 0.013
    stone_height_m: float = 0.009

    @property
    def half_size_m(self) -> float:
        """From the board's centre to its edge."""
        return (self.num_lines - 1) / 2 * self.pitch_m + self.margin_m

    def intersection_xy(self, row: int, column: int) -> np.ndarray:
        """(2,) world xy in metres of an intersection; (0, 0) is the board's centre."""
        if not (0 <= row < self.num_lines and 0 <= column < self.num_lines):
            raise ValueError(
                f"intersection ({row}, {column}) is off the board: "
                f"row and column must lie in 0..{self.num_lines - 1}"
            )
        middle = (self.num_lines - 1) / 2
        return np.array([(column - middle) * self.pitch_m, (middle - row) * self.pitch_m])

    def nearest_intersection(self, xy: np.ndarray) -> tuple[int, int]:
        """(row, column) of the intersection nearest to a world xy in metres."""
        middle = (self.num_lines - 1) / 2
        column = np.clip(round(xy[0] / self.pitch_m + middle), 0, self.num_lines - 1)
        row = np.clip(round(middle - xy[1] / self.pitch_m), 0, self.num_lines - 1)
        return int(row), int(column)


BOARD = BoardGeometry()


class Stage(StrEnum):
    """How far an episode got; each stage includes the ones before it."""

    START = "start"
    REACHED = "reached"
    GRASPED = "grasped"
    LIFTED = "lifted"
    PLACED = "placed"


class Failure(StrEnum):
    """Why an episode failed; exactly one per failed episode."""

    NEVER_REACHED = "never_reached"
    MISSED_GRASP = "missed_grasp"
    DROPPED = "dropped"
    WRONG_STONE = "wrong_stone"
    WRONG_INTERSECTION = "wrong_intersection"
    IMPRECISE = "imprecise"
    DISTURBED_OTHERS = "disturbed_others"
    TIMEOUT_HOLDING = "timeout_holding"


@dataclass(frozen=True)
class EpisodeSpec:
    """Everything that, with the code's version, determines an episode bit for bit."""

    seed: int
    suite: str = "place"
    robot: str = "scara"
    split: str = "all"
    control_mode: str = "relative"
    fps: int = DEFAULT_FPS
    # (row, column) and colour; None draws them from the seed
    target: tuple[int, int] | None = None
    color: str | None = None
    success_tolerance_mm: float = 10.0
    perturbations: str = NONE  # a condition such as "camera:2+light:3"; see `Condition`

    def __post_init__(self) -> None:
        # one spelling, so that equal conditions compare equal
        object.__setattr__(self, "perturbations", str(Condition.parse(self.perturbations)))
        one_of("--env.task", self.suite, SUITES)
        one_of("--env.robot", self.robot, ROBOTS)
        one_of("--env.split", self.split, SPLITS)
        one_of("--env.control_mode", self.control_mode, CONTROL_MODES)
        if not 0 <= self.seed <= MAX_SEED:
            raise ValueError(f"--seed={self.seed} must lie in 0..{MAX_SEED}")
        if not (0 < self.fps <= PHYSICS_HZ and PHYSICS_HZ % self.fps == 0):
            divisors = [n for n in range(1, PHYSICS_HZ + 1) if PHYSICS_HZ % n == 0]
            raise ValueError(
                f"--env.fps={self.fps} does not divide the physics rate of {PHYSICS_HZ} Hz; "
                f"choose one of: {', '.join(map(str, divisors))}"
            )
        if self.target is not None:
            self._check_target(self.target)
        if self.color is not None:
            one_of("--env.color", self.color, COLORS)
        if not 0 < self.success_tolerance_mm <= 1000 * BOARD.pitch_m / 2:
            raise ValueError(
                f"--env.success_tolerance_mm={self.success_tolerance_mm} must lie between 0 and half the "
                f"pitch, {1000 * BOARD.pitch_m / 2} mm: beyond it a stone would be on two intersections"
            )

    @staticmethod
    def _check_target(target: tuple[int, int]) -> None:
        if len(target) != 2 or not all(0 <= line < BOARD.num_lines for line in target):
            raise ValueError(
                f"--env.target={list(target)} is off the board; "
                f"give [row, column], each in 0..{BOARD.num_lines - 1}"
            )

    def for_task(self, task_id: int) -> "EpisodeSpec":
        """This spec with target and colour of a numbered task: 25 x colour + 5 x row + column."""
        num_targets = BOARD.num_lines**2
        num_tasks = num_targets * len(COLORS)
        if not 0 <= task_id < num_tasks:
            raise ValueError(f"--env.task_ids has {task_id}; {self.suite!r} has tasks 0..{num_tasks - 1}")
        color, point = divmod(task_id, num_targets)
        target = divmod(point, BOARD.num_lines)
        return dataclasses.replace(self, target=target, color=COLORS[color])

    def to_dict(self) -> dict[str, object]:
        """JSON-ready dict."""
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class RenderOptions:
    """What the cameras deliver; it changes the observation, never the physics."""

    image_size: int = DEFAULT_IMAGE_SIZE  # width and height in pixels
    preset: str = "fast"
    depth: bool = False  # deliver each camera's depth and geometry too; see camera_geometry.py

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


def task_id(target: Sequence[int], color: str) -> int:
    """The number of a task by its (row, column) and colour; the inverse of `EpisodeSpec.for_task`."""
    row, column = target
    return BOARD.num_lines**2 * COLORS.index(color) + BOARD.num_lines * row + column


def action_bounds(control_mode: str) -> tuple[np.ndarray, np.ndarray]:
    """(low, high), each (ACTION_DIM,) float32, of the action space in the environment's units."""
    if control_mode == "absolute":
        low, high = (*WORKSPACE_LOW_M, -1.0), (*WORKSPACE_HIGH_M, 1.0)
    else:
        low, high = (-1.0,) * ACTION_DIM, (1.0,) * ACTION_DIM
    return np.array(low, dtype=np.float32), np.array(high, dtype=np.float32)
