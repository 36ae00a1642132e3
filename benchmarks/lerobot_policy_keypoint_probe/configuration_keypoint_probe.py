"""Config of ``keypoint_probe``."""

from dataclasses import dataclass, field

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig, CosineDecayWithWarmupSchedulerConfig

from lerobot_bomb.flag_errors import flag_errors

GROUP_CHANNELS = 8  # of the group normalisation


@PreTrainedConfig.register_subclass("keypoint_probe")
@dataclass
class KeypointProbeConfig(PreTrainedConfig):
    """Keypoints of every camera, the robot's state and the instruction's words -> the next action."""

    n_obs_steps: int = 1
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.MEAN_STD,
        }
    )

    # keypoints that are looked for in each camera's image
    num_keypoints: int = 16
    # channels of the first convolution; the others have twice as many
    num_channels: int = 16
    # sharpness of the heat maps at the start: flat ones put every keypoint at the centre, and none learns
    initial_sharpness: float = 5.0
    # sines and cosines of each state number: with them a small network resolves millimetres sooner
    num_state_octaves: int = 2
    # size of the instruction's embedding
    word_dim: int = 32
    # units of each hidden layer
    hidden_dim: int = 256

    optimizer_lr: float = 4e-3
    optimizer_weight_decay: float = 1e-4
    optimizer_grad_clip_norm: float = 1.0
    # shares of a schedule that LeRobot shortens to --steps
    scheduler_warmup_steps: int = 10_000
    scheduler_decay_steps: int = 1_000_000
    scheduler_decay_lr: float = 2e-5

    push_to_hub: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        with flag_errors():
            self._check()

    def _check(self) -> None:
        if self.n_obs_steps != 1:
            raise ValueError(
                f"--policy.n_obs_steps={self.n_obs_steps}: keypoint_probe reads 1 observation step"
            )
        for flag in ("num_keypoints", "word_dim", "hidden_dim", "scheduler_decay_steps"):
            if getattr(self, flag) < 1:
                raise ValueError(f"--policy.{flag}={getattr(self, flag)} must be at least 1")
        if self.num_channels < 1 or self.num_channels % GROUP_CHANNELS:
            raise ValueError(
                f"--policy.num_channels={self.num_channels} must be a multiple of {GROUP_CHANNELS}"
            )
        if self.num_state_octaves < 0:
            raise ValueError(f"--policy.num_state_octaves={self.num_state_octaves} must not be negative")

    def validate_features(self) -> None:
        """Raise unless the dataset (or environment) has what the policy reads and writes."""
        inputs = sorted(self.input_features or {})
        if not self.image_features:
            raise ValueError(f"keypoint_probe needs at least one camera; the dataset has the inputs {inputs}")
        if self.robot_state_feature is None:
            raise ValueError(f"keypoint_probe needs 'observation.state'; the dataset has the inputs {inputs}")
        if self.action_feature is None:
            raise ValueError(f"keypoint_probe needs the feature 'action'; got {self.output_features}")

    def get_optimizer_preset(self) -> AdamWConfig:
        return AdamWConfig(
            lr=self.optimizer_lr,
            weight_decay=self.optimizer_weight_decay,
            grad_clip_norm=self.optimizer_grad_clip_norm,
        )

    def get_scheduler_preset(self) -> CosineDecayWithWarmupSchedulerConfig:
        return CosineDecayWithWarmupSchedulerConfig(
            num_warmup_steps=self.scheduler_warmup_steps,
            num_decay_steps=self.scheduler_decay_steps,
            peak_lr=self.optimizer_lr,
            decay_lr=self.scheduler_decay_lr,
        )

    @property
    def observation_delta_indices(self) -> None:
        return None

    @property
    def action_delta_indices(self) -> None:
        return None

    @property
    def reward_delta_indices(self) -> None:
        return None
