"""Fit of a policy to an environment whose datasets state only shapes and statistics."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.utils.constants import ACTION, POLICY_POSTPROCESSOR_DEFAULT_NAME
from safetensors import safe_open

from lerobot_bomb.checkpoints.acting import OVERRIDE, acting_config, name_of
from lerobot_bomb.checkpoints.environment import trained_environment
from lerobot_bomb.checkpoints.identity import weights_file
from lerobot_bomb.compat.hooks.policies import training_data

# share of the range of actions; demonstrations that span less of it are in another unit
LEAST_SPAN = 0.01
UNNORMALIZER = f"{POLICY_POSTPROCESSOR_DEFAULT_NAME}_step_*_unnormalizer_processor.safetensors"


@dataclass(frozen=True)
class Interface:
    """Interface of an environment: its observations and actions."""

    env_type: str
    features: Mapping[str, PolicyFeature]  # by the policy's names
    action_range: tuple[float, float] | None  # where any dimension's values lie; None: anywhere
    action_meaning: str
    image_flags: Callable[[int, int], str]  # (height, width) -> the flags of images of this size

    def check_acting_policy(self) -> None:
        """Check, as far as is known, that the acting policy was trained for this kind of environment.

        Raises:
            ValueError: it was trained for another one; the message says what differs and the way out.
        """
        if (config := acting_config()) is None:
            return
        who = name_of(config)
        trained_for = trained_environment(config)
        if trained_for is not None:
            raise ValueError(
                f"{who} was trained for {trained_for}; this is --env.type={self.env_type}: evaluate with "
                f"{' '.join(trained_for.eval_flags())}, or {OVERRIDE}"
            )
        self._check_features(config, who)
        self._check_actions(config, who)

    def _check_features(self, config: PreTrainedConfig, who: str) -> None:
        of_policy = {**(config.input_features or {}), **(config.output_features or {})}
        for name in self.features.keys() & of_policy.keys():
            here, there = tuple(self.features[name].shape), tuple(of_policy[name].shape)
            if here == there:
                continue
            if self.features[name].type is FeatureType.VISUAL:
                evaluate = f"evaluate with {self.image_flags(*there[1:])}"
                raise ValueError(
                    f"{who} reads images of {there[2]}x{there[1]} pixels; this environment has "
                    f"{self.image_flags(*here[1:])}: {evaluate}, or {OVERRIDE}"
                )
            raise ValueError(
                f"{who} has {name} of shape {there}, and --env.type={self.env_type} of shape {here}: "
                "evaluate it in the environment that it was trained for"
            )

    def _check_actions(self, config: PreTrainedConfig, who: str) -> None:
        """Raise unless the least and the greatest action of the training suit the environment."""
        trained = trained_actions(config)
        if trained is None or self.action_range is None:
            return
        low, high = trained
        least, greatest = self.action_range
        is_inside = (low >= least).all() and (high <= greatest).all()
        if is_inside and (high - low).max() >= LEAST_SPAN * (greatest - least):
            return
        raise ValueError(
            f"{who} was trained on actions from {_text(low)} to {_text(high)}; those of "
            f"--env.type={self.env_type} are {self.action_meaning}, {least:g} to {greatest:g}: give a "
            f"checkpoint of such actions, or {OVERRIDE}"
        )


def trained_actions(config: PreTrainedConfig) -> tuple[np.ndarray, np.ndarray] | None:
    """(D,) least and (D,) greatest value of each dimension in a policy's training; None if unknown."""
    meta = training_data(config)
    if meta is not None:
        of_action = (meta.stats or {}).get(ACTION, {})
        return (of_action["min"], of_action["max"]) if {"min", "max"} <= of_action.keys() else None
    weights = config.pretrained_path and weights_file(
        str(config.pretrained_path), config.pretrained_revision, config.use_peft
    )
    if not weights:
        return None
    for path in Path(weights).parent.glob(UNNORMALIZER):
        with safe_open(path, "np") as tensors:
            names = [f"{ACTION}.min", f"{ACTION}.max"]
            if set(names) <= set(tensors.keys()):
                low, high = map(tensors.get_tensor, names)
                return low, high
    return None


def _text(values: np.ndarray) -> str:
    return f"({', '.join(f'{value:.4g}' for value in values.tolist())})"
