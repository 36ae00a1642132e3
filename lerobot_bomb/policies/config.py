"""Base of our policies' configs."""

from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from lerobot.configs import NormalizationMode
from lerobot.optim import AdamWConfig, CosineDecayWithWarmupSchedulerConfig

from lerobot_bomb.actions.ensemble import WEIGHTINGS
from lerobot_bomb.checkpoints.config import INSTALLED, PackageVersion
from lerobot_bomb.checkpoints.environment import ConfigWithEnvironment
from lerobot_bomb.compat.hooks.policies import training_data
from lerobot_bomb.flag_errors import flag_errors
from lerobot_bomb.flags import one_of
from lerobot_bomb.policies.pointing import LABELS
from lerobot_bomb.training.policy_flags import (
    ADAMW,
    OPTIMIZERS,
    action_deltas,
    check_cameras_and_action,
    check_chunk,
    check_crop,
    check_ensemble,
    check_model_name_and_precision,
    check_not_negative,
    check_state,
    check_training,
    cosine_decay,
    optimizer_config,
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
    """Config of chunk, normalisation and training; a policy overrides defaults by those of its paper."""

    # allowed values of flags
    CHOICES: ClassVar[dict[str, tuple]] = {"optimizer": OPTIMIZERS}
    # see `ConfigWithEnvironment`
    LATER_FIELDS: ClassVar[dict[str, Any]] = {"optimizer": ADAMW}
    # how state and action may be normalised
    MODES: ClassVar[tuple[NormalizationMode, ...]] = tuple(NormalizationMode)
    # whether a checkpoint's weights fix the number of action dims; text does not
    ACTIONS_ARE_OF_WEIGHTS: ClassVar[bool] = True
    # the same for the state's dims
    STATE_IS_OF_WEIGHTS: ClassVar[bool] = True
    # registered name of the processor step that reads the task, which every checkpoint has
    TASK_STEP: ClassVar[str]

    # observations per prediction; always 1
    n_obs_steps: int = 1
    # actions predicted at once
    chunk_size: int = 1
    # actions executed before the next prediction
    n_action_steps: int = 1
    # how images, state and action are normalised
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.MIN_MAX,
            "ACTION": NormalizationMode.MIN_MAX,
        }
    )
    # train on with the statistics of --policy.path, so that its weights mean what they did, not the dataset's
    keep_statistics: bool = False
    # also train on actions beyond an episode's end, which repeat the last one
    loss_on_padded_actions: bool = False
    # frames at an episode's end that no sample starts at
    drop_n_last_frames: int = 1
    # flags that define what the model's tokens mean, as they were in training
    trained_with: dict[str, Any] | None = None
    # batches trained on so far; randomness in the next ones follows from this number
    trained_batches: int = 0
    # version of lerobot_bomb that wrote the checkpoint
    package_version: PackageVersion = INSTALLED

    # "adamw", or "muon" for the matrices of hidden layers and AdamW for the rest
    optimizer: str = ADAMW
    # learning rate after warm-up
    optimizer_lr: float = 2e-5
    # AdamW's decay rates of the two moments
    optimizer_betas: tuple[float, float] = (0.9, 0.95)
    # AdamW's epsilon
    optimizer_eps: float = 1e-8
    # AdamW's weight decay
    optimizer_weight_decay: float = 0.0
    # largest norm of the gradients
    optimizer_grad_clip_norm: float = 1.0
    # steps in which the learning rate rises; LeRobot shortens them if --steps is below scheduler_decay_steps
    scheduler_warmup_steps: int = 1_000
    # steps after which the cosine schedule ends
    scheduler_decay_steps: int = 30_000
    # learning rate at the end of the schedule
    scheduler_decay_lr: float = 0.0

    # publish the checkpoint when the training ends; needs repo_id
    push_to_hub: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        with flag_errors():
            self.check_flags()

    def check_flags(self) -> None:
        """Raise a ValueError that names the flag unless all values go together."""
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
        """Raise unless the dataset or environment has all features that the policy reads and writes."""
        check_cameras_and_action(self)
        if self.keep_statistics and training_data(self) is not None and self.pretrained_path is None:
            raise ValueError("--policy.keep_statistics=true needs --policy.path, whose statistics to keep")

    def methods_used(self) -> str:
        return "; ".join(self.methods())

    def methods(self) -> list[str]:
        size = self.chunk_size
        return ["chunk of 1" if size == 1 else f"chunk of {size}, {self.n_action_steps} executed"]

    def get_optimizer_preset(self) -> AdamWConfig:
        return optimizer_config(self)

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
    """Config of a policy with a vision-language model: the model, its precision, its trained parts.

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

    # base model: Hub id, local folder, or "nano", a small model with random weights that needs no network
    vlm_model_name: str = ""
    # changes of nano's architecture, nested like it: {"text_config": {"num_hidden_layers": 2}}
    nano_config: dict[str, Any] | None = None
    # architecture of the base model; if it is set, nothing is downloaded and the weights come from a
    # checkpoint
    vlm_config: dict[str, Any] | None = None
    # token ids of the fixed parts of the prompt
    prompt_tokens: dict[str, Any] | None = None

    # side of the crop as a share of the image's; placed at random in training, centred in evaluation
    crop_fraction: float = 1.0
    # put the robot's state into the prompt
    use_state: bool = True
    # do not train the vision model; a nano model needs false
    freeze_vision_encoder: bool = False
    # "bfloat16": autocast over float32 weights, in training and evaluation
    dtype: str = "float32"
    # "bfloat16": cast the weights once, when a checkpoint is loaded. Half the memory, the same actions; needs
    # dtype=bfloat16, and not for training
    weights_dtype: str = "float32"
    # training with less memory and more time
    gradient_checkpointing: bool = False

    # predict at every step and execute the mean of this many newest chunks; 0: off. Needs n_action_steps=1
    temporal_ensemble_size: int = 0
    # weights in the ensemble's mean: "uniform", "exponential" (exp(coefficient * age)), "nvlabs" (1 for the
    # newest, 0.5 for others) or "adaptive" (exp(coefficient * cosine with the newest action))
    temporal_ensemble_weighting: str = "uniform"
    # coefficient of these weights; with "exponential" above 0 favours old chunks
    temporal_ensemble_coefficient: float = 0.01
    # action dimensions that are not averaged, by (part of) their names, such as gripper
    temporal_ensemble_exclude_joints: list[str] = field(default_factory=list)
    # names of the action dimensions, from the dataset
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
            "robot state as input" if self.use_state else "no robot state",
        ]

    @property
    def weights_type(self) -> torch.dtype:
        """Torch dtype of `weights_dtype`."""
        return getattr(torch, self.weights_dtype)

    @property
    def action_names(self) -> list[str]:
        """A name for every action dimension: the dataset's, or its number."""
        assert self.action_feature is not None
        num_dims = self.action_feature.shape[0]
        names = self.action_feature_names or []
        return list(names) if len(names) == num_dims else [str(dim) for dim in range(num_dims)]

    def validate_features(self) -> None:
        # labels are among a dataset's observations, so that LeRobot's pipelines keep them, but are no inputs
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


@dataclass
class TokenVlaConfig(VlaConfig):
    """Config of a policy whose actions are tokens: how they are chosen, and compiled."""

    MODES: ClassVar[tuple[NormalizationMode, ...]] = BOUNDED_MODES

    # on CUDA, compile the decoding: ten seconds for each batch size, then faster
    compile_model: bool = False
    # 0: choose the likeliest token; above: sample from softmax(logits / temperature)
    temperature: float = 0.0
    # seed of the samples; each episode has random numbers of its own
    noise_seed: int = 0

    def check_flags(self) -> None:
        super().check_flags()
        check_not_negative(self, ("temperature", "noise_seed"))
