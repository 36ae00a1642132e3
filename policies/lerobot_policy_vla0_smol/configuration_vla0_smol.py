"""Config of ``vla0_smol``."""

from dataclasses import dataclass, field
from typing import Any

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig, CosineDecayWithWarmupSchedulerConfig

from lerobot_bomb.actions.bins import BIN_MODES
from lerobot_bomb.actions.ensemble import WEIGHTINGS
from lerobot_bomb.actions.relative import named_dims
from lerobot_bomb.actions.text import MASK_LEVELS, MAX_DIGITS, digits_needed
from lerobot_bomb.checkpoint_config import INSTALLED, PackageVersion
from lerobot_bomb.flag_errors import flag_errors
from lerobot_bomb.flags import one_of
from lerobot_bomb.policy_environment import ConfigWithEnvironment
from lerobot_bomb.policy_flags import (
    action_deltas,
    adamw,
    check_cameras_and_action,
    check_chunk,
    check_ensemble,
    check_model_name_and_precision,
    check_state,
    check_training,
    cosine_decay,
)

DRAFTS = ("none", "linear")
DTYPES = ("float32", "bfloat16")
# modes that map the data into [-1, 1], where the bins are
BOUNDED_MODES = (
    NormalizationMode.MIN_MAX,
    NormalizationMode.QUANTILES,
    NormalizationMode.QUANTILE10,
    NormalizationMode.IDENTITY,
)
MAX_BINS = 10**MAX_DIGITS
# flags that say what shapes the weights have
SHAPES = ("nano_config",)
# the same, and flags that say what the model's tokens mean
AS_TRAINED = (
    *("chunk_size", "n_action_bins", "n_state_bins", "bin_mode", "number_width", "use_state"),
    *SHAPES,
)


@PreTrainedConfig.register_subclass("vla0_smol")
@dataclass
class Vla0SmolConfig(ConfigWithEnvironment):
    """A SmolVLM writes ``chunk_size`` actions as integers; ``n_action_steps`` of them are executed."""

    # Hub id, path of a local folder, or "nano": a small model with random weights, built in code
    vlm_model_name: str = "HuggingFaceTB/SmolVLM2-500M-Video-Instruct"
    # changes of nano's architecture, nested as it is, as {"vision_config": {"num_hidden_layers": 2}}
    nano_config: dict[str, Any] | None = None
    # architecture; filled in when the base model is loaded. Set = build this and download nothing:
    # the weights then come from a checkpoint
    vlm_config: dict[str, Any] | None = None
    # token ids of the fixed parts of the prompt; filled in together with vlm_config
    prompt_tokens: dict[str, Any] | None = None

    n_obs_steps: int = 1
    # actions in the text
    chunk_size: int = 10
    # actions executed before the next prediction
    n_action_steps: int = 5
    # statistics to [-1, 1] for what becomes bins; images stay in [0, 1]
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.MIN_MAX,
            "ACTION": NormalizationMode.MIN_MAX,
        }
    )

    # values an action number can take, from 0
    n_action_bins: int = 512
    # values a state number can take, from 0
    n_state_bins: int = 512
    # "centers" (bins as intervals) or "levels" (bins as points, -1 and 1 included)
    bin_mode: str = "centers"
    # digits of every number, zero-padded; 0 = as many as the number has
    number_width: int = 0
    # whether the robot's state is in the prompt
    use_state: bool = True
    # text of a system message before the prompt
    system_prompt: str | None = None

    # actions as differences to the state that a chunk starts from, converted inside the policy. LeRobot's
    # name for it, use_relative_actions, makes its fine-tuning look for processor steps of its own
    relative_actions: bool = False
    # action dimensions that stay absolute, by (part of) their names
    relative_exclude_joints: list[str] = field(default_factory=list)
    # the state dimension of each relative action dimension; None = the same number
    relative_state_indices: list[int] | None = None
    # filled in by LeRobot from the dataset
    action_feature_names: list[str] | None = None

    # chunks that an executed action is the mean of, one predicted every step; 0 = a queue instead
    temporal_ensemble_size: int = 0
    # "uniform", "exponential" (exp(coefficient * age)) or "nvlabs" (1 for the newest, 0.5 for others)
    temporal_ensemble_weighting: str = "uniform"
    # positive favours old chunks
    temporal_ensemble_coefficient: float = 0.01
    # action dimensions that are not averaged, by (part of) their names
    temporal_ensemble_exclude_joints: list[str] = field(default_factory=list)

    # what a pass of the model guesses and checks beside the next token: "linear" (actions go on as in the
    # answer's last two steps) or "none". Same actions, fewer passes
    draft: str = "linear"

    # side of the crop as a fraction of the image: random place while training, centre otherwise
    crop_fraction: float = 0.875

    # what is hidden as one while training: a number, all numbers of a step, or single characters
    mask_level: str = "value"
    # upper end of the fraction of numbers (steps, characters) that are hidden
    mask_max_fraction: float = 0.15
    # probability that nothing is hidden in a sample
    mask_skip_prob: float = 0.1

    # whether numbers beyond an episode's end (repeats of the last action) are trained on
    loss_on_padded_actions: bool = False
    # frames at an episode's end that no sample starts at
    drop_n_last_frames: int = 1
    freeze_vision_encoder: bool = False
    # "bfloat16" = autocast over float32 weights, in training and in evaluation
    dtype: str = "float32"
    gradient_checkpointing: bool = False
    # answers on CUDA by `torch.compile`: some ten seconds for every size of batch, then faster
    compile_model: bool = False
    # values of AS_TRAINED; filled in for checkpoints
    trained_with: dict[str, Any] | None = None
    # batches trained on so far; what is random in the next ones follows from it
    trained_batches: int = 0
    # of lerobot_bomb, which wrote the checkpoint
    package_version: PackageVersion = INSTALLED

    optimizer_lr: float = 5e-5
    optimizer_betas: tuple[float, float] = (0.9, 0.95)
    optimizer_eps: float = 1e-8
    optimizer_weight_decay: float = 0.01
    optimizer_grad_clip_norm: float = 1.0
    scheduler_warmup_steps: int = 1_000
    scheduler_decay_steps: int = 30_000
    scheduler_decay_lr: float = 5e-6

    push_to_hub: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        with flag_errors():
            self._check_choices()
            check_chunk(self)
            check_ensemble(self)
            self._check_numbers()
            self._check_training()

    def _check_choices(self) -> None:
        one_of("--policy.bin_mode", self.bin_mode, BIN_MODES)
        one_of("--policy.mask_level", self.mask_level, MASK_LEVELS)
        one_of("--policy.draft", self.draft, DRAFTS)
        one_of("--policy.dtype", self.dtype, DTYPES)
        one_of("--policy.temporal_ensemble_weighting", self.temporal_ensemble_weighting, WEIGHTINGS)
        check_model_name_and_precision(self)
        for kind, allowed in {
            "VISUAL": (NormalizationMode.IDENTITY,),
            "STATE": BOUNDED_MODES,
            "ACTION": BOUNDED_MODES,
        }.items():
            one_of(f"--policy.normalization_mapping[{kind}]", self.normalization_mapping.get(kind), allowed)

    def _check_numbers(self) -> None:
        for flag, bins in {"n_action_bins": self.n_action_bins, "n_state_bins": self.n_state_bins}.items():
            if not 2 <= bins <= MAX_BINS:
                raise ValueError(f"--policy.{flag}={bins} must lie in 2..{MAX_BINS}")
            if self.number_width and not digits_needed(bins) <= self.number_width <= MAX_DIGITS:
                raise ValueError(
                    f"--policy.number_width={self.number_width} must be 0 (no padding) or lie in "
                    f"{digits_needed(bins)}..{MAX_DIGITS} for --policy.{flag}={bins}"
                )

    def _check_training(self) -> None:
        check_training(self)
        for flag in ("mask_max_fraction", "mask_skip_prob"):
            if not 0 <= getattr(self, flag) <= 1:
                raise ValueError(f"--policy.{flag}={getattr(self, flag)} must lie in 0..1")

    def validate_features(self) -> None:
        """Raise unless the dataset (or environment) has what the policy reads and writes."""
        check_cameras_and_action(self)
        check_state(self, ("use_state", "relative_actions"))

    @property
    def action_names(self) -> list[str]:
        """A name for every action dimension: the dataset's, or its number."""
        assert self.action_feature is not None
        num_dims = self.action_feature.shape[0]
        names = self.action_feature_names or []
        return list(names) if len(names) == num_dims else [str(dim) for dim in range(num_dims)]

    def relative_dims(self) -> dict[int, int]:
        """{action dimension that is relative: its state dimension}.

        Raises:
            ValueError: an excluded name or a state dimension does not exist, or their numbers differ.
        """
        assert self.robot_state_feature is not None
        num_states = self.robot_state_feature.shape[0]
        flag = "--policy.relative_exclude_joints"
        excluded = named_dims(self.action_names, self.relative_exclude_joints, flag)
        dims = [dim for dim in range(len(self.action_names)) if dim not in excluded]
        indices = self.relative_state_indices
        if indices is None and num_states == len(self.action_names):
            indices = dims
        if indices is None or len(indices) != len(dims):
            raise ValueError(
                f"--policy.relative_actions=true: {len(dims)} of {len(self.action_names)} action dimensions "
                f"are relative and the state has {num_states}; give --policy.relative_state_indices with "
                f"{len(dims)} of them, in order"
            )
        if not all(0 <= index < num_states for index in indices):
            raise ValueError(
                f"--policy.relative_state_indices={indices} must lie in 0..{num_states - 1} "
                f"(dimensions of observation.state)"
            )
        return dict(zip(dims, indices, strict=True))

    def get_optimizer_preset(self) -> AdamWConfig:
        return adamw(self)

    def get_scheduler_preset(self) -> CosineDecayWithWarmupSchedulerConfig:
        return cosine_decay(self)

    @property
    def observation_delta_indices(self) -> None:
        return None

    @property
    def action_delta_indices(self) -> list[int] | None:
        return action_deltas(self)

    @property
    def reward_delta_indices(self) -> None:
        return None
