"""Config of ``keypoint_probe``."""

from dataclasses import dataclass, field
from typing import ClassVar

from lerobot.configs import NormalizationMode, PreTrainedConfig

from lerobot_bomb.policies.config import ChunkConfig
from lerobot_bomb.training.policy_flags import check_not_negative, check_positive

GROUP_CHANNELS = 8  # of the group normalisation


@PreTrainedConfig.register_subclass("keypoint_probe")
@dataclass
class KeypointProbeConfig(ChunkConfig):
    """Keypoints of every camera, the robot's state and the instruction's words -> the next action."""

    TASK_STEP: ClassVar[str] = "keypoint_probe_words"

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

    drop_n_last_frames: int = 0
    optimizer_lr: float = 4e-3
    optimizer_betas: tuple[float, float] = (0.9, 0.999)
    optimizer_weight_decay: float = 1e-4
    # shares of a schedule that LeRobot shortens to --steps
    scheduler_warmup_steps: int = 10_000
    scheduler_decay_steps: int = 1_000_000
    scheduler_decay_lr: float = 2e-5

    def check_flags(self) -> None:
        super().check_flags()
        check_positive(self, ("num_keypoints", "num_channels", "word_dim", "hidden_dim"))
        check_not_negative(self, ("num_state_octaves",))
        if self.num_channels % GROUP_CHANNELS:
            raise ValueError(
                f"--policy.num_channels={self.num_channels} must be a multiple of {GROUP_CHANNELS}"
            )
        if self.chunk_size != 1:
            raise ValueError(f"--policy.chunk_size={self.chunk_size}: keypoint_probe predicts 1 action")

    def validate_features(self) -> None:
        """Raise unless the dataset (or environment) has what the policy reads and writes."""
        super().validate_features()
        if self.robot_state_feature is None:
            raise ValueError(
                "keypoint_probe needs 'observation.state'; the dataset has the inputs "
                f"{sorted(self.input_features or {})}"
            )
