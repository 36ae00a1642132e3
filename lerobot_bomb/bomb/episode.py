"""An episode: its spec, its stages, its failure class."""

import dataclasses
from dataclasses import dataclass
from enum import StrEnum

from lerobot_bomb.bomb.board import BOARD, COLORS
from lerobot_bomb.bomb.perturbations import Condition
from lerobot_bomb.bomb.suites import SUITES
from lerobot_bomb.conditions import NONE, PerturbedSpec
from lerobot_bomb.failures import FailureClass
from lerobot_bomb.flags import one_of

# Version of the measurement of a policy and of the records. 1.1 is 1.0 with records that name simulator,
# policy and tasks. A suite has a version of its own, for its episodes: `bomb/suite.py`.
PROTOCOL_VERSION = "1.1"

ROBOTS = ("scara", "fetch", "so101")
SIMULATORS = ("mujoco", "sapien")  # of the physics
CONTROL_MODES = ("relative", "absolute", "joints")  # the last one: of the robot so101
SPLITS = ("all", "train", "heldout")

DEFAULT_FPS = 10  # control steps per second
PHYSICS_HZ = 200  # physics steps per second; a multiple of the control rate
MAX_SEED = 2**32 - 1  # the largest seed that NumPy accepts from LeRobot
TEST_SEEDS = range(1000, 1200)  # of evaluations: from LeRobot's default on, as many as the protocol asks for
DROP_HEIGHT_M = 0.030  # a stone let go higher than this above its resting height was dropped, not placed
OFF_BOARD_M = 0.75 * BOARD.pitch_m  # from the nearest intersection
COLLATERAL_TOLERANCE_MM = 10.0  # another stone that is moved farther was disturbed


class Stage(StrEnum):
    """Stage that an episode reached; each stage includes the ones before it."""

    START = "start"
    REACHED = "reached"
    GRASPED = "grasped"
    LIFTED = "lifted"
    PLACED = "placed"


class Failure(FailureClass):
    """Reason why an episode failed; exactly one per failed episode."""

    NEVER_REACHED = "never_reached", "the stone never between the pads"
    MISSED_GRASP = "missed_grasp", "the stone never lifted"
    DROPPED = (
        "dropped",
        f"the stone let go more than {1e3 * DROP_HEIGHT_M:g} mm above its resting height; or at rest more "
        f"than {1e3 * OFF_BOARD_M:g} mm from every intersection; or lifted earlier but, when time ran out, "
        "neither held nor on the target",
    )
    WRONG_STONE = "wrong_stone", "another stone carried"
    WRONG_INTERSECTION = "wrong_intersection", "put down nearest to another intersection"
    IMPRECISE = "imprecise", "nearest to the target, but outside the tolerance or not flat"
    DISTURBED_OTHERS = (
        "disturbed_others",
        f"well placed, but another stone moved by more than {COLLATERAL_TOLERANCE_MM:g} mm",
    )
    TIMEOUT_HOLDING = (
        "timeout_holding",
        "time running out with both pads on the stone; or, once it was lifted, with one pad on it or with "
        "the stone still moving on the target",
    )
    LIFTED = "lifted", "a stone lifted instead of pushed (only in `goal`)"


def check_seed(seed: int) -> None:
    """Raise a ValueError unless LeRobot can use this seed."""
    if not 0 <= seed <= MAX_SEED:
        raise ValueError(f"--seed={seed} must lie in 0..{MAX_SEED}")


@dataclass(frozen=True)
class EpisodeSpec(PerturbedSpec):
    """Everything that, with the code's version, determines an episode bit for bit."""

    seed: int  # number from which everything random is drawn
    suite: str = "place"  # --env.task
    robot: str = "scara"  # --env.robot
    split: str = "all"  # --env.split
    control_mode: str = "relative"  # --env.control_mode
    fps: int = DEFAULT_FPS  # control steps per second
    # requested row and column; null: drawn
    target: tuple[int, int] | None = None
    # requested colour of the stone; null: drawn
    color: str | None = None
    # requested task of a suite other than place, whose tasks are target and color; null: drawn
    task_id: int | None = None
    success_tolerance_mm: float = 10.0  # distance from the target within which a placement counts
    perturbations: str = NONE  # condition, such as camera:2+light:3; a range may be in it
    simulator: str = "mujoco"  # --env.simulator

    def __post_init__(self) -> None:
        object.__setattr__(self, "perturbations", Condition(self.perturbations))
        one_of("--env.task", self.suite, SUITES)
        one_of("--env.robot", self.robot, ROBOTS)
        one_of("--env.simulator", self.simulator, SIMULATORS)
        one_of("--env.split", self.split, SPLITS)
        one_of("--env.control_mode", self.control_mode, CONTROL_MODES)
        if self.control_mode == "joints" and self.robot != "so101":
            raise ValueError(
                f"--env.control_mode=joints commands the joints of --env.robot=so101, not of {self.robot}"
            )
        check_seed(self.seed)
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

    def to_dict(self) -> dict[str, object]:
        """Return the spec as values that JSON can hold."""
        return dataclasses.asdict(self)
