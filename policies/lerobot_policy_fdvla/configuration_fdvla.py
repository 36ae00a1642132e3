"""Config of ``fdvla``."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig, CosineDecayWithWarmupSchedulerConfig
from lerobot.policies.rtc import RTCConfig

from lerobot_bomb.checkpoint_config import INSTALLED, PackageVersion
from lerobot_bomb.flag_errors import flag_errors
from lerobot_bomb.flags import one_of
from lerobot_bomb.flow.losses import check_learning, check_objective
from lerobot_bomb.flow.path import TIME_SAMPLINGS
from lerobot_bomb.flow.samplers import check_heads, check_sampling
from lerobot_bomb.policy_environment import ConfigWithEnvironment
from lerobot_bomb.policy_flags import (
    MAX_POSITIONS,
    action_deltas,
    adamw,
    check_cameras_and_action,
    check_chunk,
    check_model_name_and_precision,
    check_not_negative,
    check_positive,
    check_state,
    check_training,
    cosine_decay,
)

DTYPES = ("float32", "bfloat16")
TRAIN_VLM = ("full", "frozen")
SEGMENT_ATTENTIONS = ("bidirectional", "causal")
REASONING_POOLS = ("text", "all_prefix", "last")
CONSISTENCY_LOSS_WEIGHT = 0.1
PIXELS_PER_TOKEN = 28  # of a side: 2 patches of 14
# flags that say which weights there are, and their shapes
SHAPES = (
    "nano_config",
    "chunk_size",
    "use_state",
    "use_flow_head",
    "use_denoise_head",
    "dualmod_flow",
    "dualmod_denoise",
    "head_dim",
    "dualmod_dim",
)
# the same, and flags that say what the model's tokens mean
AS_TRAINED = (*SHAPES, "image_size", "segment_attention", "reasoning_pool")


@PreTrainedConfig.register_subclass("fdvla")
@dataclass
class FdvlaConfig(ConfigWithEnvironment):
    """A Qwen2.5-VL reads noisy actions beside pictures and text; two heads take them to clean ones."""

    # Hub id, path of a local folder, or "nano": a small model with random weights, built in code
    vlm_model_name: str = "Qwen/Qwen2.5-VL-3B-Instruct"
    # changes of nano's architecture, nested as it is, as {"vision_config": {"num_hidden_layers": 2}}
    nano_config: dict[str, Any] | None = None
    # architecture; filled in when the base model is loaded. Set = build this and download nothing:
    # the weights then come from a checkpoint
    vlm_config: dict[str, Any] | None = None
    # token ids of the fixed parts of the prompt; filled in together with vlm_config
    prompt_tokens: dict[str, Any] | None = None

    n_obs_steps: int = 1
    # actions of a chunk
    chunk_size: int = 16
    # actions executed before the next prediction
    n_action_steps: int = 8
    # images stay in [0, 1]; what noise of N(0, I) becomes should have its spread
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.MEAN_STD,
        }
    )
    # side in pixels of what the vision model sees; a token stands for 28 x 28 of them
    image_size: int = 224
    # side of the crop as a fraction of the image: random place while training, centre otherwise
    crop_fraction: float = 1.0
    # whether the robot's state is in the prompt, as one embedding
    use_state: bool = True

    # predicts the velocity from noise to actions
    use_flow_head: bool = True
    # predicts the noise
    use_denoise_head: bool = True
    # whether pooled states of the prompt scale and shift the features of each head
    dualmod_flow: bool = True
    dualmod_denoise: bool = True
    # what is pooled: the instruction's "text", "all_prefix", or the "last" token before the actions
    reasoning_pool: str = "text"
    # "bidirectional": the tokens of a chunk read each other; "causal": what stands before them
    segment_attention: str = "bidirectional"
    # widths of the heads' features and of what modulates them
    head_dim: int = 1024
    dualmod_dim: int = 512

    flow_loss_weight: float = 1.0
    denoise_loss_weight: float = 1.0
    # of the heads' disagreement; None = 0.1 with both heads, else 0
    consistency_loss_weight: float | None = None
    # what agrees: "linear", "energy_vjp" (second derivatives: small models only) or "none"
    consistency: str = "linear"
    # the head that agreeing does not train: "none", "flow" or "denoise"
    consistency_detach: str = "none"
    # how much noise training shows: "uniform", or "beta", which shows much of it more often
    time_sampling: str = "uniform"
    # times and noises that each chunk of a batch is trained at; the prompt is read once for all
    draws_per_chunk: int = 1

    # "residual", "flow", "ddim", "sde" or "paper"; None = residual with both heads, else that of the one
    sampler: str | None = None
    # "euler" or "heun"
    solver: str = "euler"
    num_inference_steps: int = 10
    # how much of the noise head residual, sde and paper take, in 0..1
    refine_alpha: float = 0.3
    # where on the way from noise (0) to actions (1) ddim starts
    denoise_tau_min: float = 0.02
    # bound of the actions that ddim infers, in normalised units
    clip_sample_range: float = 5.0
    # LeRobot's real-time chunking; set by lerobot-rollout --inference.type=rtc
    rtc_config: RTCConfig | None = None

    # whether actions beyond an episode's end (repeats of the last one) are read and trained on
    loss_on_padded_actions: bool = False
    # frames at an episode's end that no sample starts at
    drop_n_last_frames: int = 0
    # "full" or "frozen": the language model
    train_vlm: str = "full"
    freeze_vision_encoder: bool = True
    # "bfloat16" = autocast over float32 weights, in training and in evaluation
    dtype: str = "bfloat16"
    gradient_checkpointing: bool = False
    # values of AS_TRAINED; filled in for checkpoints
    trained_with: dict[str, Any] | None = None
    # batches trained on so far; what is random in the next ones follows from it
    trained_batches: int = 0
    # of lerobot_bomb, which wrote the checkpoint
    package_version: PackageVersion = INSTALLED

    optimizer_lr: float = 2e-5
    optimizer_betas: tuple[float, float] = (0.9, 0.95)
    optimizer_eps: float = 1e-8
    optimizer_weight_decay: float = 1e-10
    optimizer_grad_clip_norm: float = 1.0
    scheduler_warmup_steps: int = 1_000
    scheduler_decay_steps: int = 30_000
    scheduler_decay_lr: float = 2.5e-6

    push_to_hub: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        with flag_errors():
            self._check_choices()
            check_chunk(self)
            self._check_loss_weights()
            with _policy_flags():
                self._check_heads()
            check_positive(self, ("head_dim", "dualmod_dim", "image_size", "draws_per_chunk"))
            if self.image_size % PIXELS_PER_TOKEN:
                raise ValueError(
                    f"--policy.image_size={self.image_size} must be a multiple of {PIXELS_PER_TOKEN} pixels"
                )
            if (num_tokens := (self.image_size // PIXELS_PER_TOKEN) ** 2) > MAX_POSITIONS:
                raise ValueError(
                    f"--policy.image_size={self.image_size} makes {num_tokens} tokens of a picture; the "
                    f"model has {MAX_POSITIONS} positions"
                )
            check_training(self)

    def _check_choices(self) -> None:
        for flag, allowed in {
            "reasoning_pool": REASONING_POOLS,
            "segment_attention": SEGMENT_ATTENTIONS,
            "time_sampling": TIME_SAMPLINGS,
            "train_vlm": TRAIN_VLM,
            "dtype": DTYPES,
        }.items():
            one_of(f"--policy.{flag}", getattr(self, flag), allowed)
        check_model_name_and_precision(self)
        for kind, allowed in {
            "VISUAL": (NormalizationMode.IDENTITY,),
            "STATE": tuple(NormalizationMode),
            "ACTION": tuple(NormalizationMode),
        }.items():
            one_of(f"--policy.normalization_mapping[{kind}]", self.normalization_mapping.get(kind), allowed)
        if self.train_vlm == "frozen" and not self.freeze_vision_encoder:
            raise ValueError(
                "--policy.freeze_vision_encoder=false needs --policy.train_vlm=full: frozen freezes both"
            )

    def _check_loss_weights(self) -> None:
        check_not_negative(self, ("flow_loss_weight", "denoise_loss_weight"))
        if self.consistency_loss_weight is not None:
            check_not_negative(self, ("consistency_loss_weight",))

    def _check_heads(self) -> None:
        heads = self.use_flow_head, self.use_denoise_head
        check_objective(self.consistency, self.consistency_detach, self.used_consistency_weight, *heads)
        check_sampling(**self.sampling())
        check_heads(self.used_sampler, *heads)
        check_learning(
            self.flow_loss_weight,
            self.denoise_loss_weight,
            self.used_consistency_weight,
            self.consistency,
            self.consistency_detach,
            *heads,
        )
        if self.has_energy and self.gradient_checkpointing:
            raise ValueError(
                "consistency=energy_vjp takes second derivatives, which --policy.gradient_checkpointing=true "
                "cannot compute again; give one of them up"
            )

    @property
    def has_energy(self) -> bool:
        """Whether the loss has a term that takes second derivatives."""
        return self.consistency == "energy_vjp" and self.used_consistency_weight > 0

    def sampling(self) -> dict[str, Any]:
        """Options of `lerobot_bomb.flow.samplers.sample`."""
        return {
            "sampler": self.used_sampler,
            "solver": self.solver,
            "num_inference_steps": self.num_inference_steps,
            "refine_alpha": self.refine_alpha,
            "denoise_tau_min": self.denoise_tau_min,
            "clip_sample_range": self.clip_sample_range,
        }

    @property
    def used_sampler(self) -> str:
        """The sampler asked for, or the one for the heads that there are."""
        if self.sampler is not None:
            return self.sampler
        if self.use_flow_head:
            return "residual" if self.use_denoise_head else "flow"
        return "ddim"

    @property
    def used_consistency_weight(self) -> float:
        """The weight asked for, or the one for the heads that there are."""
        if self.consistency_loss_weight is not None:
            return self.consistency_loss_weight
        return CONSISTENCY_LOSS_WEIGHT if self.use_flow_head and self.use_denoise_head else 0.0

    def validate_features(self) -> None:
        """Raise unless the dataset (or environment) has what the policy reads and writes."""
        check_cameras_and_action(self)
        check_state(self, ("use_state",))

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


@contextmanager
def _policy_flags() -> Iterator[None]:
    """Errors that begin with the name of an option, as `lerobot_bomb.flow` raises them, name the flag."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"--policy.{error}") from None
