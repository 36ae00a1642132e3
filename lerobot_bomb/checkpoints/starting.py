"""Start of a training from a checkpoint, and advice where that is impossible."""

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.utils.constants import ACTION, OBS_STATE
from lerobot.utils.feature_utils import dataset_to_policy_features

from lerobot_bomb.checkpoints.names import CONFIG, is_hub_id

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDatasetMetadata

logger = logging.getLogger(__name__)


def way_to_start_otherwise(checkpoint: str | Path, policy_type: str) -> str:
    """Describe how a checkpoint's vision-language model becomes the start of a policy for other data."""
    return (
        "for other cameras, state or action, start from its vision-language model: lerobot-bomb "
        f"checkpoint export-backbone --policy.path={checkpoint} --output=FOLDER, then lerobot-train "
        f"--policy.type={policy_type} --policy.vlm_model_name=FOLDER"
    )


def check_start(checkpoint: str | Path, config: Any, meta: "LeRobotDatasetMetadata | None") -> None:
    """Raise a ValueError unless a config can start from a checkpoint on its data or in its environment.

    Where weights do not depend on shapes (sizes of images, numbers written as text), the config takes the
    data's.
    """
    if not _has_config(checkpoint):
        return
    saved: Any = PreTrainedConfig.from_pretrained(checkpoint)
    if _lacks_architecture(config) and not _lacks_architecture(saved):
        raise ValueError(
            f"--policy.type={config.type} --policy.pretrained_path={checkpoint}: this type continues from a "
            f"checkpoint with --policy.path={checkpoint}, which takes its config, too; "
            f"{way_to_start_otherwise(checkpoint, config.type)}"
        )
    if meta is None:
        _fit_environment(checkpoint, config, saved)
    else:
        _fit(checkpoint, config, saved, dataset_to_policy_features(meta.features))


def _has_config(checkpoint: str | Path) -> bool:
    return (Path(checkpoint) / CONFIG).is_file() or is_hub_id(checkpoint)


def _lacks_architecture(config: Any) -> bool:
    return getattr(config, "vlm_config", {}) is None


def _fit_environment(checkpoint: str | Path, config: Any, saved: Any) -> None:
    """Raise a ValueError if a config's actions, which are the environment's, are not the checkpoint's."""
    there, here = ((each.output_features or {}).get(ACTION) for each in (saved, config))
    if there and here and tuple(there.shape) != tuple(here.shape):
        trained = f"; it was trained for {saved.environment}" if saved.environment else ""
        raise ValueError(
            f"--policy.path={checkpoint} acts with {there.shape[0]} numbers, this environment takes "
            f"{here.shape[0]}{trained}"
        )


def _fit(checkpoint: str | Path, config: Any, saved: Any, of_data: dict[str, PolicyFeature]) -> None:
    otherwise = way_to_start_otherwise(checkpoint, config.type)
    of_checkpoint = {**(saved.input_features or {}), **(saved.output_features or {})}
    for key, is_of_weights in (
        (ACTION, config.ACTIONS_ARE_OF_WEIGHTS or getattr(config, "relative_actions", False)),
        (OBS_STATE, config.STATE_IS_OF_WEIGHTS and getattr(config, "use_state", True)),
    ):
        there, here = (features.get(key) for features in (of_checkpoint, of_data))
        if is_of_weights and there and here and tuple(there.shape) != tuple(here.shape):
            raise ValueError(
                f"--policy.path={checkpoint} has {key!r} of shape {tuple(there.shape)}, this dataset has it "
                f"of shape {tuple(here.shape)}; {otherwise}"
            )
    cameras = {
        key for key, feature in (config.input_features or {}).items() if feature.type is FeatureType.VISUAL
    }
    if absent := sorted(cameras - of_data.keys()):
        logger.warning(
            "--policy.path=%s reads %s; this dataset has %s. Unless --rename_map gives them these names, %s",
            checkpoint,
            ", ".join(absent),
            ", ".join(key for key, feature in of_data.items() if feature.type is FeatureType.VISUAL),
            otherwise,
        )
    shared = {key for key in (*cameras, OBS_STATE) if key in of_data and key in (config.input_features or {})}
    config.input_features = {**(config.input_features or {}), **{key: of_data[key] for key in shared}}
