"""An episode of LIBERO: its spec, and its failure class."""

from dataclasses import dataclass

from lerobot_bomb.bomb.episode import check_seed
from lerobot_bomb.conditions import NONE, PerturbedSpec
from lerobot_bomb.failures import FailureClass
from lerobot_bomb.flags import one_of
from lerobot_bomb.libero.assets import SUITES
from lerobot_bomb.libero.perturbations import LiberoCondition

# Version of the axes and of how a policy is measured; records carry it.
LIBERO_PROTOCOL_VERSION = "libero-1.0"
TASKS_PER_SUITE = {suite: 90 if suite == "libero_90" else 10 for suite in SUITES}
LIBERO_FPS = 20  # control steps a second, of its demonstrations and its environment
MAX_ALLOWED_STEPS = 10_000
STATE_DIM = 8  # the gripper's position, orientation as axis and angle, and its two fingers
ACTION_DIM = 7
RENDER_PRESETS = ("stock", "fast")  # fast: without multisampling, reflections and shadows
MOTION_DIMS = 6  # change of x, y, z and of orientation; the last is the gripper


class LiberoFailure(FailureClass):
    """Reason why an episode failed; exactly one per failed episode, the first that holds."""

    NEVER_TOUCHED = "never_touched", "the gripper touched no object or fixture"
    WRONG_OBJECT = "wrong_object", "the gripper touched some, but none of the task's"
    UNFINISHED = "unfinished", "anything else"
    # of the scripted expert, whatever the gripper touched
    NO_GRASP = "no_grasp", "the expert's planner found no free grasp"
    NO_PLACE = (
        "no_place",
        "the expert's planner found no free place that the goal accepts and a grasp can reach",
    )
    NO_PATH = "no_path", "the expert's planner found no free path of the gripper"


@dataclass(frozen=True)
class LiberoSpec(PerturbedSpec):
    """Everything that, with the versions of code and simulator, determines an episode."""

    seed: int  # number from which everything random is drawn
    suite: str = SUITES[0]  # --env.task
    task_id: int = 0  # number of the task in its suite
    max_steps: int | None = None  # control steps after which the episode ends; null: LeRobot's limit
    perturbations: str = NONE  # condition, such as table:2+light:3

    def __post_init__(self) -> None:
        object.__setattr__(self, "perturbations", LiberoCondition(self.perturbations))
        one_of("--env.task", self.suite, SUITES)
        count = TASKS_PER_SUITE[self.suite]
        if not 0 <= self.task_id < count:
            raise ValueError(f"--env.task_ids: {self.suite} has no task {self.task_id}, only 0..{count - 1}")
        check_seed(self.seed)
        if self.max_steps is not None and not 1 <= self.max_steps <= MAX_ALLOWED_STEPS:
            raise ValueError(f"--env.episode_length={self.max_steps} must lie in 1..{MAX_ALLOWED_STEPS}")


def initial_state_of(seed: int, count: int) -> int:
    """Return the index of the recorded initial state that an episode of a task starts in.

    `lerobot-eval --env.type=libero` goes through these states in order, whatever its seed. So episodes are
    the same here if --seed is a multiple of their number, 50, as its default 1000 is.
    """
    return seed % count


def libero_failure_of(touched: set[str], wanted: set[str]) -> LiberoFailure:
    """Classify an episode without success, by the objects that the gripper met and those of the task."""
    if not touched:
        return LiberoFailure.NEVER_TOUCHED
    return LiberoFailure.UNFINISHED if touched & wanted else LiberoFailure.WRONG_OBJECT
