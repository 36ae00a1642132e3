"""Config of ``fdvla``."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, ClassVar

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.policies.rtc import RTCConfig

from lerobot_bomb.flow.losses import check_learning, check_objective
from lerobot_bomb.flow.path import TIME_SAMPLINGS
from lerobot_bomb.flow.samplers import (
    CLIP_SAMPLE_RANGE,
    DENOISE_TAU_MIN,
    NUM_INFERENCE_STEPS,
    REFINE_ALPHA,
    SAMPLER,
    SOLVER,
    check_heads,
    check_sampling,
)
from lerobot_bomb.policies.flag_groups import short_help
from lerobot_bomb.policies.pointing_config import PlacesVlaConfig
from lerobot_bomb.policies.relative_config import RELATIVE_AS_TRAINED, RelativeVlaConfig
from lerobot_bomb.training.policy_flags import (
    MAX_POSITIONS,
    check_not_negative,
    check_positive,
)

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
    "pointing",
)
# those, and flags that say what the model's tokens mean
AS_TRAINED = (
    *SHAPES,
    *("image_size", "segment_attention", "reasoning_pool"),
    *RELATIVE_AS_TRAINED,
)


@PreTrainedConfig.register_subclass("fdvla")
@short_help
@dataclass
class FdvlaConfig(RelativeVlaConfig, PlacesVlaConfig):
    """A Qwen2.5-VL reads noisy actions beside images and text; two heads take them to clean ones.

    More flags, for research: docs/reference/policies.md.
    """

    CHOICES: ClassVar[dict[str, tuple]] = {
        **RelativeVlaConfig.CHOICES,
        "reasoning_pool": REASONING_POOLS,
        "segment_attention": SEGMENT_ATTENTIONS,
        "time_sampling": TIME_SAMPLINGS,
        "train_vlm": TRAIN_VLM,
    }

    RESEARCH: ClassVar[tuple[str, ...]] = (
        *("use_flow_head", "use_denoise_head", "dualmod_flow", "dualmod_denoise", "head_dim", "dualmod_dim"),
        *("reasoning_pool", "segment_attention", "time_sampling"),
        *("flow_loss_weight", "denoise_loss_weight", "consistency_loss_weight"),
        *("consistency", "consistency_detach", "refine_alpha", "denoise_tau_min", "clip_sample_range"),
        *("noise_seed", "noise_per_episode"),
    )
    NEEDS_STATE: ClassVar[tuple[str, ...]] = (*RelativeVlaConfig.NEEDS_STATE, "pointing")

    # base model: Hub id, local folder, or "nano", a small model with random weights that needs no network
    vlm_model_name: str = "Qwen/Qwen2.5-VL-3B-Instruct"

    # actions predicted at once
    chunk_size: int = 16
    # actions executed before the next prediction
    n_action_steps: int = 8
    # how images, state and action are normalised; actions should have the spread of noise of N(0, I)
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.MEAN_STD,
        }
    )
    # pixels a side that the vision model sees, a multiple of 28; a token stands for 28 x 28 of them
    image_size: int = 224

    # have the head that predicts the velocity from noise to actions
    use_flow_head: bool = True
    # have the head that predicts the noise
    use_denoise_head: bool = True
    # let the instruction's pooled states scale and shift the flow head's features
    dualmod_flow: bool = True
    # let them scale and shift the denoising head's features
    dualmod_denoise: bool = True
    # states that DualMod pools: the instruction's ("text"), "all_prefix", or the "last" before the actions
    reasoning_pool: str = "text"
    # tokens of a chunk attend to each other ("bidirectional") or to earlier ones ("causal")
    segment_attention: str = "bidirectional"
    # width of the heads' features
    head_dim: int = 1024
    # width of the network that modulates them
    dualmod_dim: int = 512

    # weight of the flow head's loss
    flow_loss_weight: float = 1.0
    # weight of the denoising head's loss
    denoise_loss_weight: float = 1.0
    # weight of the heads' disagreement; unset: 0.1 with both heads, else 0
    consistency_loss_weight: float | None = None
    # how disagreement is measured: "linear", "energy_vjp" (second derivatives: small models only) or "none"
    consistency: str = "linear"
    # head that the disagreement does not train: "none", "flow" or "denoise"
    consistency_detach: str = "none"
    # distribution of tau in training: "uniform", or "beta", more often near the noise
    time_sampling: str = "uniform"
    # noise samples on which each chunk of a batch is trained; the prompt is read once for all
    draws_per_chunk: int = 1

    # "residual", "flow", "ddim", "sde" or "paper"; unset: residual with both heads, else that of the one
    sampler: str | None = None
    # "euler", or "heun" with two evaluations per step
    solver: str = SOLVER
    # sampling steps
    num_inference_steps: int = NUM_INFERENCE_STEPS
    # share of the denoising head in residual, sde and paper, 0 to 1
    refine_alpha: float = REFINE_ALPHA
    # tau at which ddim starts
    denoise_tau_min: float = DENOISE_TAU_MIN
    # bound of the actions that ddim infers, normalised
    clip_sample_range: float = CLIP_SAMPLE_RANGE
    # weights in the ensemble's mean: "uniform", "exponential" (exp(coefficient * age)), "nvlabs" (1 for the
    # newest, 0.5 for others) or "adaptive" (exp(coefficient * cosine with the newest action))
    temporal_ensemble_weighting: str = "exponential"
    # seed of the noise from which actions are sampled
    noise_seed: int = 0
    # each episode has noise of its own; else all have the same
    noise_per_episode: bool = False
    # LeRobot's real-time chunking; set by lerobot-rollout --inference.type=rtc
    rtc_config: RTCConfig | None = None

    # frames at an episode's end that no sample starts at
    drop_n_last_frames: int = 0
    # train the whole language model ("full") or nothing of it ("frozen")
    train_vlm: str = "full"
    # do not train the vision model; a nano model needs false
    freeze_vision_encoder: bool = True
    # "bfloat16": autocast over float32 weights, in training and evaluation
    dtype: str = "bfloat16"

    optimizer_weight_decay: float = 1e-10
    scheduler_decay_lr: float = 2.5e-6

    def check_flags(self) -> None:
        super().check_flags()
        if self.train_vlm == "frozen" and not self.freeze_vision_encoder:
            raise ValueError(
                "--policy.freeze_vision_encoder=false needs --policy.train_vlm=full: frozen freezes both"
            )
        check_not_negative(self, ("flow_loss_weight", "denoise_loss_weight", "noise_seed"))
        if self.consistency_loss_weight is not None:
            check_not_negative(self, ("consistency_loss_weight",))
        with _policy_flags():
            self._check_heads()
        check_positive(self, ("head_dim", "dualmod_dim", "image_size", "draws_per_chunk"))
        if self.image_size % PIXELS_PER_TOKEN:
            raise ValueError(
                f"--policy.image_size={self.image_size} must be a multiple of {PIXELS_PER_TOKEN} pixels"
            )
        if (num_tokens := (self.image_size // PIXELS_PER_TOKEN) ** 2) > MAX_POSITIONS:
            raise ValueError(
                f"--policy.image_size={self.image_size} makes {num_tokens} tokens of an image; the "
                f"model has {MAX_POSITIONS} positions"
            )

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

    def methods(self) -> list[str]:
        heads = {"flow": self.use_flow_head, "diffusion": self.use_denoise_head}
        modulated = {"flow": self.dualmod_flow, "diffusion": self.dualmod_denoise}
        used = [name for name, is_used in heads.items() if is_used]
        of_used = [f"{name} head" for name in used if modulated[name]]
        of_heads = "both" if len(of_used) > 1 else (of_used or ["none"])[0]
        return [
            f"{' and '.join(used)} {'heads' if len(used) > 1 else 'head'}",
            f"{of_heads} modulated by the instruction",
            f"{self.used_sampler} sampler ({self.num_inference_steps} steps)",
            *super().methods(),
        ]

    @property
    def has_energy(self) -> bool:
        """True if the loss has a term that takes second derivatives."""
        return self.consistency == "energy_vjp" and self.used_consistency_weight > 0

    def sampling(self) -> dict[str, Any]:
        """Return the options of `lerobot_bomb.flow.samplers.sample`."""
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
        """Sampler of the flag, or the default for the heads."""
        if self.sampler is not None:
            return self.sampler
        if self.use_flow_head:
            return SAMPLER if self.use_denoise_head else "flow"
        return "ddim"

    @property
    def used_consistency_weight(self) -> float:
        """Weight of the flag, or the default for the heads."""
        if self.consistency_loss_weight is not None:
            return self.consistency_loss_weight
        return CONSISTENCY_LOSS_WEIGHT if self.use_flow_head and self.use_denoise_head else 0.0


@contextmanager
def _policy_flags() -> Iterator[None]:
    """Make errors of `lerobot_bomb.flow`, which begin with the name of an option, name the flag."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"--policy.{error}") from None
