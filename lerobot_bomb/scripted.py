"""Policies that are programs, not networks: what the floor and the ceiling of BOMB share."""

from abc import abstractmethod
from dataclasses import dataclass
from typing import NoReturn

from lerobot.configs import FeatureType, NormalizationMode, PreTrainedConfig
from lerobot.optim import LRSchedulerConfig, OptimizerConfig
from lerobot.policies import PreTrainedPolicy
from torch import Tensor

from lerobot_bomb.schema import ACTION_DIM, CONTROL_MODES, DEFAULT_FPS, one_of


@dataclass
class ScriptedConfig(PreTrainedConfig):
    """Config of a policy without weights; it must be told how the environment reads actions."""

    # as --env.control_mode
    control_mode: str = "relative"
    # as --env.fps
    fps: int = DEFAULT_FPS
    push_to_hub: bool = False

    def __post_init__(self) -> None:
        self.device = self.device or "cpu"
        super().__post_init__()
        one_of("--policy.control_mode", self.control_mode, CONTROL_MODES)

    @property
    def normalization_mapping(self) -> dict[str, NormalizationMode]:
        return dict.fromkeys((feature.value for feature in FeatureType), NormalizationMode.IDENTITY)

    @property
    def observation_delta_indices(self) -> None:
        return None

    @property
    def action_delta_indices(self) -> None:
        return None

    @property
    def reward_delta_indices(self) -> None:
        return None

    def get_optimizer_preset(self) -> OptimizerConfig:
        self._refuse_training()

    def get_scheduler_preset(self) -> LRSchedulerConfig | None:
        self._refuse_training()

    def validate_features(self) -> None:
        if self.action_feature is None or self.action_feature.shape != (ACTION_DIM,):
            raise ValueError(
                f"--policy.type={self.type} acts on BOMB only (actions of shape ({ACTION_DIM},)), "
                f"got output features {self.output_features}"
            )

    def _refuse_training(self) -> NoReturn:
        raise ValueError(
            f"--policy.type={self.type} is scripted and has nothing to train; evaluate it with lerobot-eval"
        )


class ScriptedPolicy(PreTrainedPolicy):
    """Base of the scripted policies: one action per call, no weights, no queue."""

    config_class = ScriptedConfig  # pyright: ignore[reportAssignmentType]  LeRobot annotates it as None
    name = "scripted"  # pyright: ignore[reportAssignmentType]
    config: ScriptedConfig

    def __init__(self, config: ScriptedConfig, **_: object) -> None:
        super().__init__(config)
        config.validate_features()
        self.reset()

    @abstractmethod
    def select_action(self, batch: dict[str, Tensor], **_: object) -> Tensor:
        """One action (B, D) per environment, in the environment's own units."""

    def predict_action_chunk(self, batch: dict[str, Tensor], **_: object) -> Tensor:
        """(B, 1, D): a chunk of one step."""
        return self.select_action(batch).unsqueeze(1)

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict | None]:
        self.config._refuse_training()

    def get_optim_params(self) -> dict:
        self.config._refuse_training()

    def reset(self) -> None:
        """Nothing to forget."""
