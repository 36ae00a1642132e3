"""Config of ``vla0_smol``."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

from lerobot.configs import PreTrainedConfig

from lerobot_bomb.actions.bins import BIN_MODES
from lerobot_bomb.actions.text import MASK_LEVELS, MAX_DIGITS, digits_needed
from lerobot_bomb.policies.config import TokenVlaConfig
from lerobot_bomb.policies.flag_groups import short_help
from lerobot_bomb.policies.pointing_config import PointingVlaConfig
from lerobot_bomb.policies.relative_config import RELATIVE_AS_TRAINED, RelativeVlaConfig
from lerobot_bomb.training.policy_flags import check_positive

DRAFTS = ("none", "linear")
MAX_BINS = 10**MAX_DIGITS
# largest brightness, contrast, saturation and hue
COLOR_JITTER_MOST = (1.0, 1.0, 1.0, 0.5)
# flags that say which weights there are, and their shapes
SHAPES = ("nano_config", "pointing")
# those, and flags that say what the model's tokens mean
AS_TRAINED = (
    *("chunk_size", "n_action_bins", "n_state_bins", "bin_mode", "number_width", "use_state", "image_size"),
    "pointing_range_m",
    *RELATIVE_AS_TRAINED,
    *SHAPES,
)


@PreTrainedConfig.register_subclass("vla0_smol")
@short_help
@dataclass
class Vla0SmolConfig(RelativeVlaConfig, TokenVlaConfig, PointingVlaConfig):
    """A model writes ``chunk_size`` actions as integers; ``n_action_steps`` of them are executed.

    More flags, for research: docs/reference/policies.md.
    """

    CHOICES: ClassVar[dict[str, tuple]] = {
        **TokenVlaConfig.CHOICES,
        "bin_mode": BIN_MODES,
        "mask_level": MASK_LEVELS,
        "draft": DRAFTS,
    }
    ACTIONS_ARE_OF_WEIGHTS: ClassVar[bool] = False
    STATE_IS_OF_WEIGHTS: ClassVar[bool] = False
    LATER_FIELDS: ClassVar[dict[str, Any]] = {**PointingVlaConfig.LATER_FIELDS, "pointing_range_m": 0.3}
    RESEARCH: ClassVar[tuple[str, ...]] = (
        *("n_state_bins", "pointing_range_m", "system_prompt", "draft", "color_jitter"),
        *("mask_level", "mask_skip_prob"),
    )
    NEEDS_STATE: ClassVar[tuple[str, ...]] = (*RelativeVlaConfig.NEEDS_STATE, "pointing")

    # base model: Hub id, local folder, or "nano", a small model with random weights that needs no network
    vlm_model_name: str = "HuggingFaceTB/SmolVLM2-500M-Video-Instruct"

    # pixels a side that the vision model sees; unset: a SmolVLM's own, its only one; 224 for Qwen2.5-VL,
    # which takes multiples of 28
    image_size: int | None = None

    # actions predicted at once
    chunk_size: int = 10
    # actions executed before the next prediction
    n_action_steps: int = 5

    # values that an action's number can take, 2 to 10000
    n_action_bins: int = 512
    # values that a state's number can take
    n_state_bins: int = 512
    # a number stands for an interval ("centers") or for a point, -1 and 1 included ("levels")
    bin_mode: str = "centers"
    # digits of every number, zero-padded; 0: as many as it needs
    number_width: int = 0
    # bins of the points cover plus and minus this many metres
    pointing_range_m: float = 0.3
    # system message before the prompt; unset: none, or Qwen2.5-VL's own
    system_prompt: str | None = None

    # guess that actions continue like the last two steps ("linear"), or guess nothing ("none"). The actions
    # are the same, up to ties within rounding
    draft: str = "linear"

    # side of the crop as a share of the image's; placed at random in training, centred in evaluation
    crop_fraction: float = 0.875

    # changes of brightness, contrast, saturation and hue in training, as in torchvision's ColorJitter;
    # VLA-0's are [0.2, 0.2, 0.2, 0.05]; unset: none
    color_jitter: list[float] | None = None

    # unit that is hidden in training: a number ("value"), all numbers of a step, or a character
    mask_level: str = "value"
    # hide up to this share of the numbers (steps, characters) in training
    mask_max_fraction: float = 0.15
    # probability that nothing is hidden in a sample
    mask_skip_prob: float = 0.1

    optimizer_lr: float = 5e-5
    optimizer_weight_decay: float = 0.01
    scheduler_decay_lr: float = 5e-6

    def check_flags(self) -> None:
        super().check_flags()
        for flag, bins in {"n_action_bins": self.n_action_bins, "n_state_bins": self.n_state_bins}.items():
            if not 2 <= bins <= MAX_BINS:
                raise ValueError(f"--policy.{flag}={bins} must lie in 2..{MAX_BINS}")
            if self.number_width and not digits_needed(bins) <= self.number_width <= MAX_DIGITS:
                raise ValueError(
                    f"--policy.number_width={self.number_width} must be 0 (no padding) or lie in "
                    f"{digits_needed(bins)}..{MAX_DIGITS} for --policy.{flag}={bins}"
                )
        if not 0 < self.pointing_range_m < math.inf:
            raise ValueError(
                f"--policy.pointing_range_m={self.pointing_range_m} must be finite and greater than 0"
            )
        if self.image_size is not None:
            check_positive(self, ("image_size",))
        self._check_color_jitter()
        for flag in ("mask_max_fraction", "mask_skip_prob"):
            if not 0 <= getattr(self, flag) <= 1:
                raise ValueError(f"--policy.{flag}={getattr(self, flag)} must lie in 0..1")

    def methods(self) -> list[str]:
        is_masked = self.mask_max_fraction > 0 and self.mask_skip_prob < 1
        return [
            f"{self.n_action_bins} bins per number",
            *super().methods(),
            f"masking up to {100 * self.mask_max_fraction:g} % ({self.mask_level})"
            if is_masked
            else "no masking",
            "colour jitter" if self.color_jitter else "no colour jitter",
        ]

    def _check_color_jitter(self) -> None:
        reach, most = self.color_jitter, COLOR_JITTER_MOST
        if reach is None:
            return
        if len(reach) != len(most) or not all(0 <= x <= limit for x, limit in zip(reach, most, strict=True)):
            raise ValueError(
                f"--policy.color_jitter={reach} must be four numbers: brightness, contrast and saturation in "
                f"0..1, hue in 0..0.5; VLA-0's are [0.2, 0.2, 0.2, 0.05]"
            )

    def check_masking(self) -> None:
        """Raise a ValueError if the masking flags would hide nothing.

        Of n units of a chunk a fraction below ``mask_max_fraction`` is hidden, rounded down.

        Raises:
            ValueError: that hides none of them.
        """
        if self.mask_max_fraction == 0 or self.mask_skip_prob == 1:
            return
        num_numbers = self.chunk_size * len(self.action_names)
        num_units = {
            "step": self.chunk_size,
            "value": num_numbers,
            "char": num_numbers * (1 + (self.number_width or 1)),  # at least
        }[self.mask_level]
        if num_units * self.mask_max_fraction > 1:
            return
        more = (
            f"more than 1/{num_units} = {1 / num_units:.3g}" if num_units > 1 else "--policy.mask_level=value"
        )
        raise ValueError(
            f"--policy.mask_max_fraction={self.mask_max_fraction}: of the {num_units} that "
            f"--policy.mask_level={self.mask_level} may hide in a chunk it hides none; "
            f"give {more}, or 0 to hide nothing"
        )
