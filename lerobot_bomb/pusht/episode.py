"""An episode of PushT: its spec, and its failure class."""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from math import degrees, pi

import numpy as np

from lerobot_bomb.bomb.episode import check_seed
from lerobot_bomb.conditions import NONE, PerturbedSpec, nuisances_of
from lerobot_bomb.failures import FailureClass
from lerobot_bomb.flags import one_of
from lerobot_bomb.pusht.perturbations import PUSHT_AXES, PushTCondition

# Version of the task, its axes and how a policy is measured; records carry it.
PUSHT_PROTOCOL_VERSION = "pusht-1.0"
PUSHT_EXTRA = "lerobot_policy_bomb[pusht]"  # what pip installs gym-pusht with
INSTRUCTIONS = ("templates", NONE)
BOARD_PX = 512  # the side of the board; positions and actions are in its pixels
FPS = 10  # control steps per second; gym-pusht has no other rate
MAX_STEPS = 300  # gym-pusht's own limit
MAX_ALLOWED_STEPS = 10_000
IMAGE_SIZE = 96  # pixels, gym-pusht's own
MIN_IMAGE_SIZE, MAX_IMAGE_SIZE = 32, 512

CENTRE_PX = 45.0  # from the point that is the block's position, along the stem, to the T's centre
SUCCESS_COVERAGE = 0.95  # gym-pusht's own: above it the episode is a success
ALMOST_COVERAGE = 0.8
NEAR_PX = 40.0  # between the T's centre and the target's
TURNED_RAD = pi / 9
AWAY_PX = 10.0  # further than at the start


class PushTFailure(FailureClass):
    """Reason why an episode failed, by how it ended; exactly one per failed episode, the first that holds."""

    NEVER_TOUCHED = "never_touched", "the agent never touched the block"
    ALMOST = "almost", f"at least {ALMOST_COVERAGE:g} of the target is covered"
    TURNED_WRONG = (
        "turned_wrong",
        f"the block is within {NEAR_PX:g} pixels of the target, but turned by more than "
        f"{degrees(TURNED_RAD):.0f} degrees",
    )
    PUSHED_AWAY = "pushed_away", f"the block is more than {AWAY_PX:g} pixels further away than at the start"
    TIMEOUT = "timeout", "anything else"


@dataclass(frozen=True)
class PushTSpec(PerturbedSpec):
    """Everything that, with the code's version, determines an episode bit for bit."""

    seed: int  # number from which everything random is drawn
    instruction: str = INSTRUCTIONS[0]  # templates, or none: the empty text of LeRobot's `pusht`
    max_steps: int = MAX_STEPS  # control steps after which the episode ends
    perturbations: str = NONE  # condition, such as table:2+goal:3

    def __post_init__(self) -> None:
        object.__setattr__(self, "perturbations", PushTCondition(self.perturbations))
        one_of("--env.instruction", self.instruction, INSTRUCTIONS)
        check_seed(self.seed)
        if not 1 <= self.max_steps <= MAX_ALLOWED_STEPS:
            raise ValueError(f"--env.max_steps={self.max_steps} must lie in 1..{MAX_ALLOWED_STEPS}")
        on = {axis for axis, _, _ in self.condition.ranges}
        if self.instruction == NONE and "language" in on and not on.issuperset(nuisances_of(PUSHT_AXES)):
            raise ValueError(
                f"--env.perturbations={self.perturbations!r} rewords the instruction, of which "
                "--env.instruction=none leaves nothing; drop one of them (all:3 stays allowed)"
            )


def check_installed(tasks: Sequence[str] = ()) -> None:
    """Raise a ValueError unless gym-pusht is installed, whatever the tasks."""
    if find_spec("gym_pusht") is None:
        raise ValueError(f"--env.type=bomb_pusht needs gym-pusht: pip install '{PUSHT_EXTRA}'")


def check_image_size(image_size: int) -> None:
    """Raise a ValueError unless images of this many pixels a side can be drawn."""
    if not MIN_IMAGE_SIZE <= image_size <= MAX_IMAGE_SIZE:
        raise ValueError(f"--env.image_size={image_size} must lie in {MIN_IMAGE_SIZE}..{MAX_IMAGE_SIZE}")


def pusht_failure_of(
    start: np.ndarray, end: np.ndarray, goal: np.ndarray, coverage: float, touched: bool
) -> PushTFailure:
    """Classify a failed episode, by (3,) poses x, y in pixels and angle in radians of block and target."""
    if not touched:
        return PushTFailure.NEVER_TOUCHED
    if coverage >= ALMOST_COVERAGE:
        return PushTFailure.ALMOST
    before_px, after_px = (float(np.linalg.norm(centre(pose) - centre(goal))) for pose in (start, end))
    turned_rad = abs((end[2] - goal[2] + pi) % (2 * pi) - pi)
    if after_px <= NEAR_PX and turned_rad > TURNED_RAD:
        return PushTFailure.TURNED_WRONG
    return PushTFailure.PUSHED_AWAY if after_px > before_px + AWAY_PX else PushTFailure.TIMEOUT


def centre(pose: np.ndarray) -> np.ndarray:
    """(3,) pose of a T -> (2,) centre of mass in pixels."""
    return pose[:2] + CENTRE_PX * np.array([-np.sin(pose[2]), np.cos(pose[2])])
