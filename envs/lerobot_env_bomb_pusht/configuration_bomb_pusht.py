"""LeRobot's env type ``bomb_pusht``. The only module of this package that imports LeRobot."""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig, env_to_policy_features
from lerobot.processor import PolicyProcessorPipeline
from lerobot.utils.constants import ACTION, OBS_IMAGE, OBS_STATE

from lerobot_bomb.checkpoints.identity import policy_of_results
from lerobot_bomb.checkpoints.interface import Interface
from lerobot_bomb.checkpoints.queries import last_query
from lerobot_bomb.compat.use import use
from lerobot_bomb.envs.vector import LazyVectorEnv, check_parallel_tasks
from lerobot_bomb.flag_errors import flag_errors
from lerobot_bomb.flags import one_of
from lerobot_bomb.pusht.episode import (
    BOARD_PX,
    FPS,
    IMAGE_SIZE,
    INSTRUCTIONS,
    MAX_STEPS,
    PushTSpec,
    check_image_size,
    check_installed,
)
from lerobot_bomb.pusht.perturbations import PushTCondition
from lerobot_bomb.results.writing import check_results_path
from lerobot_env_bomb_pusht import GYM_ID

TASKS = ("pusht",)
AGENT_POS, PIXELS = "agent_pos", "pixels"  # what gym-pusht calls them


@EnvConfig.register_subclass("bomb_pusht")
@dataclass
class BombPushTEnvConfig(EnvConfig):
    """Flags of ``--env.type=bomb_pusht``; every check happens before an environment is built."""

    # pusht
    task: str | None = TASKS[0]
    # control steps per second; gym-pusht has no others
    fps: int = FPS
    # templates: a sentence; none: the empty text, as of --env.type=pusht
    instruction: str = INSTRUCTIONS[0]
    # control steps after which an episode ends
    max_steps: int = MAX_STEPS
    # conditions, each evaluated as a group of its own: ["none","table:3","table:2+goal:3","all:1-5"]
    perturbations: list[str] | str | None = None
    # width and height of the image in pixels
    image_size: int = IMAGE_SIZE
    # file that gets one JSON line per finished episode: seed, coverage, failure class
    results_path: str | None = None
    # run a checkpoint that was trained for another environment
    ignore_checkpoint: bool = False
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        use()
        with flag_errors():
            # an invalid flag raises here, before anything is built
            check_parallel_tasks(self.max_parallel_tasks)
            one_of("--env.task", self.task, TASKS)
            one_of("--env.fps", self.fps, (FPS,))
            check_image_size(self.image_size)
            for condition in self.conditions.values():
                self._spec(condition)
        if self.results_path is not None:
            self.results_path = str(Path(self.results_path).expanduser())
        self.features = {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(2,)),
            AGENT_POS: PolicyFeature(type=FeatureType.STATE, shape=(2,)),
            PIXELS: PolicyFeature(type=FeatureType.VISUAL, shape=(self.image_size, self.image_size, 3)),
        }
        self.features_map = {ACTION: ACTION, AGENT_POS: OBS_STATE, PIXELS: OBS_IMAGE}

    @property
    def gym_id(self) -> str:
        """Gymnasium id of the same environment."""
        return GYM_ID

    @property
    def conditions(self) -> dict[str, str]:
        """{key of a group of results: its condition}; the task alone where no condition is named."""
        return PushTCondition.groups(self.perturbations, str(self.task))

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of `BombPushTEnv` for the first condition."""
        condition = next(iter(self.conditions.values()))
        return {
            "spec": self._spec(condition),
            "image_size": self.image_size,
            "results_path": self.results_path,
        }

    def get_env_processors(self) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
        """Return LeRobot's processors, which change nothing, after a check of the policy that acts.

        Every command asks for them once, when its policy is built and no episode has begun.

        Raises:
            ValueError: that policy was trained for another environment.
        """
        if not self.ignore_checkpoint:
            Interface(
                str(self.type),
                env_to_policy_features(self),
                (0, BOARD_PX),
                f"pixels of the {BOARD_PX}x{BOARD_PX} board",
                lambda height, _: f"--env.image_size={height}",
            ).check_acting_policy()
        return super().get_env_processors()

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, LazyVectorEnv]]:
        """{task and condition: {0: vector env of n_envs}}; no worker starts before a first reset.

        Raises:
            ValueError: gym-pusht is not installed, or --env.results_path cannot be written.
        """
        check_installed()
        from lerobot_env_bomb_pusht.env import BombPushTEnv  # imports the simulator

        check_results_path(self.results_path)
        return {
            key: {
                0: LazyVectorEnv(
                    [partial(BombPushTEnv, **(self.gym_kwargs | {"spec": self._spec(condition)}))] * n_envs,
                    use_async=use_async_envs and n_envs > 1,
                    known_late=partial(policy_of_results, self.results_path),
                    last_query=last_query,
                )
            }
            for key, condition in self.conditions.items()
        }

    def _spec(self, condition: str) -> PushTSpec:
        return PushTSpec(0, self.instruction, self.max_steps, condition)
