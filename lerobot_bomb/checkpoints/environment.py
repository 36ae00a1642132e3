"""The environment that a policy was trained for, and the check that the policy acts in no other."""

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from lerobot.configs import PreTrainedConfig

from lerobot_bomb.bomb.environment import IMAGES, Environment
from lerobot_bomb.checkpoints.acting import OVERRIDE, acting_config, name_of
from lerobot_bomb.checkpoints.training import dataset_of, read_train_config
from lerobot_bomb.compat.hooks.policies import training_data
from lerobot_bomb.compat.use import use
from lerobot_bomb.data.facts import DatasetFacts
from lerobot_bomb.flag_errors import FlagError, check_eval_flags

logger = logging.getLogger(__name__)


@dataclass
class ConfigWithEnvironment(PreTrainedConfig):
    """Base of our policies' configs: the environment of the training, and what a checkpoint needs."""

    # fields that a release added -> the value with which a policy acts as before, and is the same in results
    LATER_FIELDS: ClassVar[dict[str, Any]] = {}

    # environment of the recording that it was trained on
    environment: Environment | None = None
    # of earlier releases, whose checkpoints have it: now --env.ignore_checkpoint
    ignore_environment: bool = False

    def __post_init__(self) -> None:
        use()
        if self.ignore_environment:
            raise FlagError(
                "--policy.ignore_environment=true is now --env.ignore_checkpoint=true, for every policy"
            )
        super().__post_init__()

    def missing_parts(self) -> str | None:
        """Describe what a checkpoint with this config lacks, and what it would need; None if nothing."""
        return None

    def methods_used(self) -> str:
        """Return the methods of its type that a checkpoint of this config uses; '' if there is no choice."""
        return ""


def check_acting_policy(here: Environment) -> None:
    """Check that the policy that acts was trained for this environment, as far as is known.

    Raises:
        ValueError: it was trained for another one; the message names the flags to change.
    """
    if (config := acting_config()) is not None:
        _check(config, name_of(config), here)


def trained_environment(config: PreTrainedConfig) -> Environment | None:
    """Return the environment that a policy was trained for.

    It is taken from the dataset that the policy is being trained on, else from its config, else from the
    dataset that its training names.
    """
    if training_data(config) is None:
        environment = getattr(config, "environment", None)
        if environment is not None:
            return environment
    return environment_of_dataset(dataset_of_training(config))


def environment_of_dataset(root: Path | str | None) -> Environment | None:
    """Return the environment of a dataset; None if the folder is gone, or holds no recording of BOMB."""
    facts = DatasetFacts.find(root)
    return None if facts is None else facts.environment


def dataset_of_training(config: PreTrainedConfig) -> Path | None:
    """Return the folder of the dataset that a policy is being trained on, or was trained on.

    It may be gone. None if unknown.
    """
    meta, path = training_data(config), config.pretrained_path
    if meta is not None:
        return meta.root
    return None if path is None else dataset_of(read_train_config(Path(path)))


def _check(config: PreTrainedConfig, who: str, here: Environment) -> None:
    environment = trained_environment(config)
    if environment is not None:
        environment.check_same(here, who, OVERRIDE)
        if environment.task is None:
            logger.warning(
                "%s does not know the suite that it was trained for, so none was compared: --env.task must "
                "be that of its training",
                who,
            )
        return
    _check_image_size(config, here, who)
    if config.pretrained_path:
        logger.warning(
            "%s does not know the environment that it was trained for; only the size of its images could be "
            "compared. --env.control_mode, --env.fps and --env.robot must be those of its training",
            who,
        )


def complete_evaluation(config: Any) -> None:
    """Fill in the values of LeRobot's EvalPipelineConfig that its policy's checkpoint knows.

    Raises:
        FlagError: the evaluation would run no episode, or record several.
    """
    check_eval_flags(config)
    if hasattr(config.env, "take_image_size"):
        config.env.take_image_size(config.policy)


def side_of_images(config: PreTrainedConfig | None, cameras: Iterable[str]) -> int | None:
    """Return the side of the square images that a policy's config declares; None if it declares none."""
    features = (config and config.input_features) or {}
    shapes = (features[IMAGES + camera].shape for camera in cameras if IMAGES + camera in features)
    return next((height for _, height, width in shapes if height == width), None)


def _check_image_size(config: PreTrainedConfig, here: Environment, who: str) -> None:
    """Raise if the config's inputs (3, H, W) have another size than the cameras' images here."""
    for camera in here.cameras:
        feature = (config.input_features or {}).get(f"{IMAGES}{camera}")
        if feature is None or tuple(feature.shape[1:]) == (here.image_size,) * 2:
            continue
        height, width = feature.shape[1:]
        raise ValueError(
            f"{who} reads images of {width}x{height} pixels from the camera {camera}; this environment has "
            f"--env.image_size={here.image_size}: evaluate with --env.image_size={width}, or {OVERRIDE}"
        )
