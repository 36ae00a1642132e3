"""Checks and presets that the configs of all our policies share; errors name the flag.

Each config calls the checks of the fields that it has.
"""

import json
import math
from collections.abc import Iterable
from typing import Any

from lerobot.optim import AdamWConfig, CosineDecayWithWarmupSchedulerConfig

from lerobot_bomb.training.muon import MuonConfig
from lerobot_bomb.vlm.tokenizer import NANO

ADAMW, MUON = OPTIMIZERS = "adamw", "muon"
MAX_POSITIONS = 128_000  # of Qwen2.5-VL; LeRobot lists a chunk's frames before it builds a policy


def check_model_name_and_precision(config: Any) -> None:
    """Check that a backbone is named, nano alone is changed, and precision is left to ``dtype``."""
    check_architecture(config)
    if not config.vlm_model_name:
        raise ValueError(
            "--policy.vlm_model_name is empty; give a Hub id, the path of a local folder, or nano"
        )
    if config.nano_config and config.vlm_model_name != NANO:
        raise ValueError(
            f"--policy.nano_config={config.nano_config} changes --policy.vlm_model_name={NANO}, not "
            f"{config.vlm_model_name}"
        )
    if config.use_amp:
        raise ValueError(
            f"--policy.use_amp=true is not used by {config.type}, in training or evaluation; "
            f"give --policy.dtype=bfloat16 instead"
        )
    if config.weights_dtype == "bfloat16" != config.dtype:
        raise ValueError("--policy.weights_dtype=bfloat16 needs --policy.dtype=bfloat16")


def check_architecture(config: Any) -> None:
    """Raise unless a checkpoint describes its backbone fully; no command line gives these fields."""
    if config.vlm_config is not None and not (config.vlm_config and config.prompt_tokens):
        raise ValueError(
            f"--policy.vlm_config={config.vlm_config}, --policy.prompt_tokens={config.prompt_tokens}: they "
            "come together, with a checkpoint (--policy.path=FOLDER); leave them out to start from "
            "--policy.vlm_model_name"
        )


def check_chunk(config: Any) -> None:
    """Check that there is one observation step, and that some of a chunk's actions are executed."""
    if config.n_obs_steps != 1:
        raise ValueError(f"--policy.n_obs_steps={config.n_obs_steps}: {config.type} reads 1 observation step")
    if config.chunk_size < 1:
        raise ValueError(f"--policy.chunk_size={config.chunk_size} must be at least 1")
    if config.chunk_size > MAX_POSITIONS:
        raise ValueError(
            f"--policy.chunk_size={config.chunk_size} must be at most {MAX_POSITIONS}: no base model has "
            "more positions, and an action takes at least one"
        )
    if not 1 <= config.n_action_steps <= config.chunk_size:
        raise ValueError(
            f"--policy.n_action_steps={config.n_action_steps} must lie in 1..{config.chunk_size} "
            f"(--policy.chunk_size)"
        )


def check_ensemble(config: Any) -> None:
    """Check that a temporal ensemble fits the chunk and has no queue beside it."""
    size = config.temporal_ensemble_size
    if not 0 <= size <= config.chunk_size:
        raise ValueError(
            f"--policy.temporal_ensemble_size={size} must be 0 (no ensemble) or lie in "
            f"1..{config.chunk_size} (--policy.chunk_size)"
        )
    if size and config.n_action_steps != 1:
        raise ValueError(
            f"--policy.temporal_ensemble_size={size} predicts at every step and needs "
            f"--policy.n_action_steps=1; got {config.n_action_steps}, which is a queue"
        )
    if not math.isfinite(config.temporal_ensemble_coefficient):
        raise ValueError(
            f"--policy.temporal_ensemble_coefficient={config.temporal_ensemble_coefficient} must be finite"
        )


def check_crop(config: Any) -> None:
    """Check that the crop is part of the image, or all of it."""
    if not 0 < config.crop_fraction <= 1:
        raise ValueError(f"--policy.crop_fraction={config.crop_fraction} must lie in (0, 1]")


def check_training(config: Any) -> None:
    """Check the flags of samples, optimiser and schedule."""
    check_not_negative(
        config,
        (
            "drop_n_last_frames",
            "optimizer_lr",
            "optimizer_eps",
            "scheduler_decay_lr",
            "optimizer_weight_decay",
            "scheduler_warmup_steps",
            "trained_batches",
        ),
    )
    check_positive(config, ("scheduler_decay_steps",))


def check_not_negative(config: Any, flags: Iterable[str]) -> None:
    """Raise unless the flags are finite numbers of at least 0."""
    for flag in flags:
        value = getattr(config, flag)
        if not math.isfinite(value):
            raise ValueError(f"--policy.{flag}={value} must be finite")
        if value < 0:
            raise ValueError(f"--policy.{flag}={value} must not be negative")


def check_positive(config: Any, flags: Iterable[str]) -> None:
    """Raise unless the flags are whole numbers of at least 1."""
    for flag in flags:
        if getattr(config, flag) < 1:
            raise ValueError(f"--policy.{flag}={getattr(config, flag)} must be at least 1")


def check_cameras_and_action(config: Any) -> None:
    """Check that there is at least one camera, and one vector of actions."""
    if not config.image_features:
        raise ValueError(
            f"{config.type} needs at least one camera; the dataset has the inputs "
            f"{sorted(config.input_features or {})}"
        )
    for key, feature in config.image_features.items():
        if len(feature.shape) != 3 or feature.shape[0] != 3:
            raise ValueError(
                f"camera {key!r} has shape {feature.shape}; {config.type} needs (3, height, width)"
            )
    if config.action_feature is None or len(config.action_feature.shape) != 1:
        raise ValueError(
            f"{config.type} needs the feature 'action' of shape (D,); got {config.output_features}"
        )


def check_state(config: Any, flags: Iterable[str]) -> None:
    """Check that the robot's state is there if one of these flags needs it."""
    state = config.robot_state_feature
    for flag in flags:
        if getattr(config, flag) and (state is None or len(state.shape) != 1):
            raise ValueError(
                f"--policy.{flag}=true needs the feature 'observation.state' of shape (S,); the inputs "
                f"are {sorted(config.input_features or {})}. Give --policy.{flag}=false to do without"
            )


def trained_with(config: Any, flags: Iterable[str]) -> dict[str, Any]:
    """Return the values of flags, as JSON has them."""
    return json.loads(json.dumps({flag: getattr(config, flag) for flag in flags}))


def check_as_trained(config: Any, flags: Iterable[str]) -> None:
    """Check that a checkpoint's flags are those that its weights were trained with.

    ``flags`` are today's; an older checkpoint may lack some.
    """
    then = _then(config, flags)
    for flag, value in trained_with(config, then).items():
        if value != then[flag]:
            raise ValueError(
                f"--policy.{flag}={value!r}: this checkpoint was trained with {then[flag]!r}, which only "
                f"another training can change"
            )


def check_weights_fit(config: Any, flags: Iterable[str]) -> None:
    """Check that a training from a checkpoint has flags that fit the shapes of its weights."""
    then = _then(config, flags)
    for flag, value in trained_with(config, [flag for flag in flags if flag in then]).items():
        if value != then[flag]:
            raise ValueError(
                f"--policy.{flag}={value!r}: the weights of this checkpoint are made for {then[flag]!r}; "
                f"only a training without --policy.path can change it"
            )


def _then(config: Any, flags: Iterable[str]) -> dict[str, Any]:
    """Return the flags that a checkpoint was trained with, also those that are newer than it."""
    later = {flag: config.LATER_FIELDS[flag] for flag in flags if flag in config.LATER_FIELDS}
    return {**later, **(config.trained_with or {})}


def action_deltas(config: Any) -> list[int] | None:
    """Return the steps of a sample's actions, counted from its frame.

    None for a chunk of one, which is the frame's own action: LeRobot reads that in a third of the time.
    """
    return None if config.chunk_size == 1 else list(range(config.chunk_size))


def optimizer_config(config: Any) -> AdamWConfig:
    """Build the optimizer's config from the fields optimizer*."""
    return (MuonConfig if config.optimizer == MUON else AdamWConfig)(
        lr=config.optimizer_lr,
        betas=config.optimizer_betas,
        eps=config.optimizer_eps,
        weight_decay=config.optimizer_weight_decay,
        grad_clip_norm=config.optimizer_grad_clip_norm,
    )


def cosine_decay(config: Any) -> CosineDecayWithWarmupSchedulerConfig:
    """Build the schedule's config from the fields scheduler_*."""
    return CosineDecayWithWarmupSchedulerConfig(
        num_warmup_steps=config.scheduler_warmup_steps,
        num_decay_steps=config.scheduler_decay_steps,
        peak_lr=config.optimizer_lr,
        decay_lr=config.scheduler_decay_lr,
    )
