"""LeRobot's env type ``bomb_pusht``. The only module of this package that imports LeRobot."""

from dataclasses import dataclass, field
from typing import Any

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig, env_to_policy_features
from lerobot.utils.constants import ACTION, OBS_IMAGE, OBS_STATE

from lerobot_bomb.checkpoints.env_config import EvaluatedEnv
from lerobot_bomb.checkpoints.interface import Interface
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

TASKS = ("pusht",)
AGENT_POS, PIXELS = "agent_pos", "pixels"  # what gym-pusht calls them


@EnvConfig.register_subclass("bomb_pusht")
@dataclass
class BombPushTEnvConfig(EvaluatedEnv, EnvConfig):
    """Flags of ``--env.type=bomb_pusht``; every check happens before an environment is built."""

    # pusht
    task: str | None = TASKS[0]
    # control steps per second; gym-pusht has no others
    fps: int = FPS
    # templates: a sentence; none: the empty text, as of --env.type=pusht
    instruction: str = INSTRUCTIONS[0]
    # control steps after which an episode ends
    max_steps: int = MAX_STEPS
    # width and height of the image in pixels
    image_size: int = IMAGE_SIZE
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def _check(self) -> None:
        one_of("--env.task", self.task, TASKS)
        one_of("--env.fps", self.fps, (FPS,))
        check_image_size(self.image_size)
        _ = self.groups

    def _declare_features(self) -> None:
        self.features = {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(2,)),
            AGENT_POS: PolicyFeature(type=FeatureType.STATE, shape=(2,)),
            PIXELS: PolicyFeature(type=FeatureType.VISUAL, shape=(self.image_size, self.image_size, 3)),
        }
        self.features_map = {ACTION: ACTION, AGENT_POS: OBS_STATE, PIXELS: OBS_IMAGE}

    @property
    def groups(self) -> dict[str, dict[int, PushTSpec]]:
        """{task and condition: {0: its spec}}."""
        conditions = PushTCondition.groups(self.perturbations, str(self.task))
        return {
            key: {0: PushTSpec(0, self.instruction, self.max_steps, condition)}
            for key, condition in conditions.items()
        }

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of `BombPushTEnv` beside the spec."""
        return {
            "image_size": self.image_size,
            "results_path": self.results_path,
        }

    def _check_policy(self) -> None:
        Interface(
            str(self.type),
            env_to_policy_features(self),
            (0, BOARD_PX),
            f"pixels of the {BOARD_PX}x{BOARD_PX} board",
            lambda height, _: f"--env.image_size={height}",
        ).check_acting_policy()

    def _import_env(self) -> type:
        check_installed()
        from lerobot_env_bomb.pusht.env import BombPushTEnv  # imports the simulator

        return BombPushTEnv
