"""The base of our policies' configs."""

from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from lerobot.configs import NormalizationMode
from lerobot.optim import AdamWConfig, CosineDecayWithWarmupSchedulerConfig

from lerobot_bomb.actions.ensemble import WEIGHTINGS
from lerobot_bomb.actions.relative import named_dims
from lerobot_bomb.checkpoints.config import INSTALLED, PackageVersion
from lerobot_bomb.checkpoints.environment import ConfigWithEnvironment
from lerobot_bomb.flag_errors import flag_errors
from lerobot_bomb.flags import one_of
from lerobot_bomb.policies.pointing import LABELS
from lerobot_bomb.training.policy_flags import (
    action_deltas,
    adamw,
    check_cameras_and_action,
    check_chunk,
    check_crop,
    check_ensemble,
    check_model_name_and_precision,
    check_not_negative,
    check_state,
    check_training,
    cosine_decay,
)

DTYPES = ("float32", "bfloat16")
# modes that map the data into [-1, 1], where bins and grids are
BOUNDED_MODES = (
    NormalizationMode.MIN_MAX,
    NormalizationMode.QUANTILES,
    NormalizationMode.QUANTILE10,
    NormalizationMode.IDENTITY,
)


@dataclass
class ChunkConfig(ConfigWithEnvironment):
    """Chunk, normalisation and training; a policy overrides the defaults that its paper has."""

    # allowed values of flags
    CHOICES: ClassVar[dict[str, tuple]] = {}
    # how state and action may be normalised
    MODES: ClassVar[tuple[NormalizationMode, ...]] = tuple(NormalizationMode)
    # whether a checkpoint's weights are of actions of one size; text has any
    ACTIONS_ARE_OF_WEIGHTS: ClassVar[bool] = True
    # the same of the state
    STATE_IS_OF_WEIGHTS: ClassVar[bool] = True
    # registered name of the processor step that reads the task, which every checkpoint has
    TASK_STEP: ClassVar[str]

    n_obs_steps: int = 1
    # actions of a chunk
    chunk_size: int = 1
    # actions executed before the next prediction
    n_action_steps: int = 1
    # images stay in [0, 1]
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.MIN_MAX,
            "ACTION": NormalizationMode.MIN_MAX,
        }
    )
    # whether actions beyond an episode's end (repeats of the last one) are trained on
    loss_on_padded_actions: bool = False
    # frames at an episode's end that no sample starts at
    drop_n_last_frames: int = 1
    # values that the checkpoint was trained with; filled in
    trained_with: dict[str, Any] | None = None
    # batches trained on so far; what is random in the next ones follows from it
    trained_batches: int = 0
    # of lerobot_bomb, which wrote the checkpoint
    package_version: PackageVersion = INSTALLED

    optimizer_lr: float = 2e-5
    optimizer_betas: tuple[float, float] = (0.9, 0.95)
    optimizer_eps: float = 1e-8
    optimizer_weight_decay: float = 0.0
    optimizer_grad_clip_norm: float = 1.0
    scheduler_warmup_steps: int = 1_000
    scheduler_decay_steps: int = 30_000
    scheduler_decay_lr: float = 0.0

    push_to_hub: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        with flag_errors():
            self.check_flags()

    def check_flags(self) -> None:
        """Raise a ValueError that names the flag unless all values go together."""
        self._check_action_size()
        for flag, allowed in self.CHOICES.items():
            one_of(f"--policy.{flag}", getattr(self, flag), allowed)
        for kind, allowed in {
            "VISUAL": (NormalizationMode.IDENTITY,),
            "STATE": self.MODES,
            "ACTION": self.MODES,
        }.items():
            one_of(f"--policy.normalization_mapping[{kind}]", self.normalization_mapping.get(kind), allowed)
        check_chunk(self)
        check_training(self)

    def validate_features(self) -> None:
        """Raise unless the dataset (or environment) has what the policy reads and writes."""
        check_cameras_and_action(self)
        self._check_action_size()

    def _check_action_size(self) -> None:
        if self.ACTIONS_ARE_OF_WEIGHTS and self.action_feature is not None:
            self.check_action_size(self.action_feature.shape[0])

    def methods_used(self) -> str:
        return ", ".join(self.methods())

    def methods(self) -> list[str]:
        size = self.chunk_size
        return ["chunk of 1" if size == 1 else f"chunk of {size}, {self.n_action_steps} executed"]

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


@dataclass
class VlaConfig(ChunkConfig):
    """Config of a policy with a vision-language model: which one, in which precision, what of it is trained.

    Its chunks may be executed as an ensemble.
    """

    CHOICES: ClassVar[dict[str, tuple]] = {
        **ChunkConfig.CHOICES,
        "dtype": DTYPES,
        "weights_dtype": DTYPES,
        "temporal_ensemble_weighting": WEIGHTINGS,
    }
    TASK_STEP: ClassVar[str] = "bomb_task_tokenizer"
    # flags that need the robot's state
    NEEDS_STATE: ClassVar[tuple[str, ...]] = ("use_state",)

    # Hub id, path of a local folder, or "nano": a small model with random weights, built in code
    vlm_model_name: str = ""
    # changes of nano's architecture, nested as it is, as {"vision_config": {"num_hidden_layers": 2}}
    nano_config: dict[str, Any] | None = None
    # architecture; filled in when the base model is loaded. Set = build this and download nothing:
    # the weights then come from a checkpoint
    vlm_config: dict[str, Any] | None = None
    # token ids of the fixed parts of the prompt; filled in together with vlm_config
    prompt_tokens: dict[str, Any] | None = None

    # side of the crop as a fraction of the image: random place while training, centre otherwise
    crop_fraction: float = 1.0
    # whether the robot's state is in the prompt
    use_state: bool = True
    freeze_vision_encoder: bool = False
    # "bfloat16" = autocast over float32 weights, in training and in evaluation
    dtype: str = "float32"
    # "bfloat16" = what autocast would cast at every call is cast once, when a checkpoint is loaded: half the
    # memory, the same answers. With ``dtype=bfloat16``, and not for training
    weights_dtype: str = "float32"
    gradient_checkpointing: bool = False

    # chunks that an executed action is the mean of, one predicted every step; 0 = a queue instead
    temporal_ensemble_size: int = 0
    # "uniform", "exponential" (exp(coefficient * age)), "nvlabs" (1 for the newest, 0.5 for others) or
    # "adaptive" (exp(coefficient * cosine with the newest action))
    temporal_ensemble_weighting: str = "uniform"
    # "exponential": positive favours old chunks
    temporal_ensemble_coefficient: float = 0.01
    # action dimensions that are not averaged, by (part of) their names
    temporal_ensemble_exclude_joints: list[str] = field(default_factory=list)
    # filled in from the dataset
    action_feature_names: list[str] | None = None

    def check_flags(self) -> None:
        super().check_flags()
        check_model_name_and_precision(self)
        check_crop(self)
        check_ensemble(self)

    def methods(self) -> list[str]:
        size, side = self.temporal_ensemble_size, self.crop_fraction
        return [
            *super().methods(),
            *([f"ensemble of {size} ({self.temporal_ensemble_weighting})"] if size else []),
            "no crop" if side == 1 else f"crop to {side:g}",
            "state read" if self.use_state else "no state",
        ]

    @property
    def weights_type(self) -> torch.dtype:
        """Torch's name for it."""
        return getattr(torch, self.weights_dtype)

    @property
    def action_names(self) -> list[str]:
        """A name for every action dimension: the dataset's, or its number."""
        assert self.action_feature is not None
        num_dims = self.action_feature.shape[0]
        names = self.action_feature_names or []
        return list(names) if len(names) == num_dims else [str(dim) for dim in range(num_dims)]

    def validate_features(self) -> None:
        # labels are in a dataset's observations, where LeRobot's pipelines keep them, and are no inputs
        inputs = self.input_features or {}
        self.input_features = {key: each for key, each in inputs.items() if not key.startswith(LABELS)}
        super().validate_features()
        check_state(self, self.NEEDS_STATE)

    def missing_parts(self) -> str | None:
        if self.vlm_config is None or self.prompt_tokens is None:
            return (
                "the architecture (vlm_config and prompt_tokens), so loading it elsewhere would need the "
                f"base model {self.vlm_model_name}"
            )
        return super().missing_parts()


# flags that say what the actions of a trained model mean
RELATIVE_AS_TRAINED = ("relative_actions", "relative_exclude_joints", "relative_state_indices")


@dataclass
class RelativeVlaConfig(VlaConfig):
    """Config of a policy whose actions may be differences to the state that a chunk starts from."""

    NEEDS_STATE: ClassVar[tuple[str, ...]] = (*VlaConfig.NEEDS_STATE, "relative_actions")

    # actions as such differences, converted inside the policy. LeRobot's name for it, use_relative_actions,
    # makes its fine-tuning look for processor steps of its own
    relative_actions: bool = False
    # action dimensions that stay absolute, by (part of) their names
    relative_exclude_joints: list[str] = field(default_factory=list)
    # the state dimension of each relative action dimension; None = the same number
    relative_state_indices: list[int] | None = None

    def methods(self) -> list[str]:
        return [*super().methods(), "relative actions" if self.relative_actions else "absolute actions"]

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


@dataclass
class TokenVlaConfig(VlaConfig):
    """Config of a policy whose actions are tokens: how they are chosen, and compiled."""

    MODES: ClassVar[tuple[NormalizationMode, ...]] = BOUNDED_MODES

    # answers on CUDA by `torch.compile`: some ten seconds for every size of batch, then faster
    compile_model: bool = False
    # what is chosen: the likeliest token (0), or a sample of softmax(logits / temperature)
    temperature: float = 0.0
    # of the samples; every episode has its own
    noise_seed: int = 0

    def check_flags(self) -> None:
        super().check_flags()
        check_not_negative(self, ("temperature", "noise_seed"))
