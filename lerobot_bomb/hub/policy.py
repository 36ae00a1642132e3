"""Policies on the Hub: publishing in one commit with a card, loading with clear errors."""

import logging
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, ClassVar, cast

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.utils.constants import CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK, PRETRAINED_MODEL_DIR
from safetensors import safe_open
from torch import Tensor

from lerobot_bomb.checkpoints.adapters import base_commit, check_adapters_fit, check_base
from lerobot_bomb.checkpoints.checks import (
    ADAPTERS,
    PROCESSORS,
    check_config,
    check_finite,
    check_tensors,
    processor_files,
)
from lerobot_bomb.checkpoints.environment import environment_of_dataset
from lerobot_bomb.checkpoints.names import WEIGHTS, is_hub_id
from lerobot_bomb.data.facts import DatasetFacts
from lerobot_bomb.data.statistics import mending, wrong_statistics
from lerobot_bomb.finite import require_finite_statistics
from lerobot_bomb.hub.card import Checkpoint
from lerobot_bomb.hub.method import Method
from lerobot_bomb.hub.push import num_parameters, publish
from lerobot_bomb.training.distributed import process_number

# arguments that say how a file is fetched from the Hub
DOWNLOAD = {
    "cache_dir",
    "force_download",
    "local_files_only",
    "proxies",
    "resume_download",
    "revision",
    "token",
}

logger = logging.getLogger(__name__)

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDatasetMetadata


class HubPolicy:
    """Overrides how LeRobot's `PreTrainedPolicy` loads, saves and publishes checkpoints."""

    method: ClassVar[Method]
    # modules whose tensors a checkpoint need not have; and those it may lack because they have their weights
    may_skip: tuple[str, ...] = ()
    may_lack: tuple[str, ...] = ()
    config_class: Any
    name: Any
    config: Any

    def __init__(self, config: Any, dataset_meta: "LeRobotDatasetMetadata | None" = None):
        """Make a policy; ``dataset_meta`` is of the training dataset, whose statistics must be finite."""
        if not isinstance(config, self.config_class):
            raise ValueError(
                f"this is a {config.type}, not a {self.name}: load it with "
                f"get_policy_class({config.type!r}).from_pretrained"
            )
        _require_finite_statistics_of(dataset_meta)
        _next(super()).__init__(config)
        self._take_dataset(dataset_meta)

    @classmethod
    def from_pretrained(
        cls,
        pretrained_name_or_path: str | Path,
        *,
        dataset_meta: "LeRobotDatasetMetadata | None" = None,
        **kwargs: Any,
    ) -> Any:
        """Load as LeRobot does, but check files first; an error is one line that names the file.

        A policy that is loaded to be trained on a dataset (`dataset_meta`) takes that dataset's environment.

        Raises:
            ValueError: a file is truncated or not finite, or weights or config are of another policy.
            OSError: a file is missing, or the Hub cannot be reached.
        """
        _require_finite_statistics_of(dataset_meta)
        folder = Path(pretrained_name_or_path)
        if not folder.is_dir() and not is_hub_id(folder):
            raise FileNotFoundError(f"there is no folder {folder}, and it is no name on the Hub")
        for name in PROCESSORS:  # a policy that was saved alone has none
            if (folder / name).is_file():
                processor_files(folder, name)
        config = kwargs.pop("config", None)
        if config is None:
            download = {name: kwargs[name] for name in DOWNLOAD & kwargs.keys()}
            config = PreTrainedConfig.from_pretrained(pretrained_name_or_path, **download)
        elif config.use_peft:  # this is their base
            check_adapters_fit(cls, config, str(config.pretrained_path), config.pretrained_revision)
        if isinstance(config, cls.config_class):
            check_config(folder, config)
        policy = _next(super()).from_pretrained(pretrained_name_or_path, config=config, **kwargs)
        policy._take_dataset(dataset_meta)
        return policy

    def _take_dataset(self, dataset_meta: "LeRobotDatasetMetadata | None") -> None:
        if dataset_meta is None:
            return
        _tell_wrong_quantiles(dataset_meta, self.config.normalization_mapping.values())
        before, now = self.config.environment, environment_of_dataset(dataset_meta.root)
        if before is not None and now is not None and (names := before.differences(now)):
            logger.warning(
                "%s was trained for %s; this dataset shows %s, and so will the environment have to that the "
                "policy then acts in",
                self.config.pretrained_path or "the checkpoint",
                before.text(names),
                now.text(names),
            )
        if now is not None and now.task is None:
            logger.warning(
                "%s does not say which suite its episodes are of, so the policy will act in any: its columns "
                "bomb/* are gone, which lerobot-edit-dataset drops when it deletes or splits episodes",
                dataset_meta.root,
            )
        self.config.environment = now

    @classmethod
    def _load_as_safetensor(cls, model: Any, model_file: str, map_location: str, strict: bool) -> Any:
        path = Path(model_file)
        if not path.is_file():
            raise FileNotFoundError(f"{path.parent} holds no {path.name}, so it is no whole checkpoint")
        names = check_tensors(path, model)
        check_finite(path)
        with safe_open(path, "pt") as tensors:
            # not strictly: the names are checked, and one of tied tensors is not in the file
            model.load_state_dict({name: tensors.get_tensor(name) for name in names}, strict=False)
        return model

    def _validate_peft_config(self, peft_config: Any) -> None:
        """Store where the base is: its commit, or the absolute path of its folder.

        Adapters that will be published need a base that others can download.
        """
        _next(super())._validate_peft_config(peft_config)
        base = str(self.config.pretrained_path)
        if self.config.push_to_hub:
            check_base(base)
        peft_config.revision = base_commit(base, self.config.pretrained_revision)
        if not is_hub_id(base):
            self.config.pretrained_path = Path(base).resolve()

    def push_model_to_hub(
        self,
        cfg: TrainPipelineConfig,
        peft_model: Any = None,
        state_dict: dict[str, Tensor] | None = None,
        dataset_meta: "LeRobotDatasetMetadata | None" = None,
    ) -> None:
        """Publish in one commit, at the end of `lerobot-train --policy.push_to_hub=true`.

        LeRobot pushes the processors afterwards, and a kill in between would leave new weights with no
        processors or old ones. This commit has the last checkpoint's, which are the same, so LeRobot then
        finds nothing to change.
        """
        base = None if peft_model is None else str(peft_model.active_peft_config.base_model_name_or_path)
        if base is not None:
            check_base(base)
        card = Checkpoint(
            config=self.config,
            method=self.method,
            repo_id=self.config.repo_id,
            training=cfg,
            dataset=None if dataset_meta is None else DatasetFacts.find(dataset_meta.root),
            license=self.config.license,
            tags=self.config.tags or [],
            adapters_of=base,
        )
        assert cfg.output_dir is not None
        last = Path(cfg.output_dir) / CHECKPOINTS_DIR / LAST_CHECKPOINT_LINK / PRETRAINED_MODEL_DIR
        with TemporaryDirectory() as temporary:
            folder = Path(temporary)
            model: Any = self if peft_model is None else peft_model
            model.save_pretrained(folder, state_dict=state_dict)
            if process_number() > 0:  # LeRobot 0.6.2 calls all, as a sharded policy is gathered from all
                return
            self.config.save_pretrained(folder)
            cfg.save_pretrained(folder)
            files = {path.name: path for path in folder.iterdir() if path.suffix != ".md"}
            for name in PROCESSORS:
                if (last / name).is_file():
                    files |= {each: last / each for each in processor_files(last, name)}
            weights = next(files[name] for name in (ADAPTERS[1], WEIGHTS) if name in files)
            check_finite(weights)
            card = replace(card, num_parameters=num_parameters(weights))
            commit = publish(card, files, self.config.private)
        # LeRobot's remote jobs wait for this line
        logging.info(f"Model pushed to {commit.repo_url.url}")


def _require_finite_statistics_of(meta: "LeRobotDatasetMetadata | None") -> None:
    if meta is not None:
        require_finite_statistics(cast("Any", meta.stats))


def _tell_wrong_quantiles(meta: "LeRobotDatasetMetadata", modes: Collection[NormalizationMode]) -> None:
    """Warn if a policy is normalised by quantiles that differ from those of its dataset's frames."""
    if not {NormalizationMode.QUANTILES, NormalizationMode.QUANTILE10} & set(modes):
        return
    try:
        wrong = wrong_statistics(meta.root)
    except (OSError, ValueError):  # streamed, or damaged: whoever reads it says so
        return
    for each in wrong:
        logger.warning("%s: %s. %s", meta.root, each, mending(meta.root))


def _next(policy: Any) -> Any:
    """Return `super()` untyped, because a type checker does not see LeRobot's class here."""
    return policy
