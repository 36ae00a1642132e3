"""Push of an earlier checkpoint, with its card, to the Hub."""

import json
from collections.abc import Mapping
from copy import copy
from dataclasses import replace
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_bomb.checkpoints.names import (
    CONFIG,
    TO_PUBLISH,
    TRAIN_CONFIG,
    WEIGHTS,
    is_hub_id,
    is_local_path,
)
from lerobot_bomb.data.facts import DatasetFacts
from lerobot_bomb.files import read_json
from lerobot_bomb.hub.rates import FIGURE
from lerobot_bomb.results.record import Record

if TYPE_CHECKING:
    from huggingface_hub import CommitInfo
    from lerobot.configs import PreTrainedConfig
    from lerobot.configs.train import TrainPipelineConfig

    from lerobot_bomb.hub.card import Checkpoint

CARD = "README.md"
# fields that mean nothing on another machine; other paths keep their last part, as a name
LEFT_OUT = {"pretrained_path", "root", "output_dir", "checkpoint_path"}


def publish(checkpoint: "Checkpoint", files: Mapping[str, Path], private: bool | None) -> "CommitInfo":
    """Publish a checkpoint's files and card in one commit, which replaces an earlier checkpoint's.

    Raises:
        RuntimeError: the Hub cannot be reached or does not take them, or lacks the base of these adapters.
    """
    from huggingface_hub import HfApi

    from lerobot_bomb.hub.upload import hub_errors, upload

    base = checkpoint.adapters_of
    with hub_errors(checkpoint.repo_id):
        names = filter(is_hub_id, checkpoint.history.datasets)
        on_hub = frozenset(name for name in names if HfApi().repo_exists(name, repo_type="dataset"))
        card = replace(checkpoint, on_hub=on_hub).card()
        if base is not None and not HfApi().file_exists(base, CONFIG):
            raise RuntimeError(f"the base of these adapters, {base}, is not on the Hub; {TO_PUBLISH}")
        card.validate()
    contents: dict[str, Path | bytes] = {**files, CARD: str(card).encode()}
    figure = checkpoint.figure()
    if figure is not None:
        contents[FIGURE] = figure
    for name in {CONFIG, TRAIN_CONFIG} & files.keys():
        contents[name] = portable_json(files[name]).encode()
    message = f"{checkpoint.config.type}: weights, processors, configs and card"
    return upload(checkpoint.repo_id, "model", contents, _is_of_checkpoint, message, private)


def _is_of_checkpoint(path: str) -> bool:
    """Return True for a file of the checkpoint itself: LeRobot keeps earlier pushes in folders."""
    return "/" not in path and (path == FIGURE or path.endswith((".json", ".safetensors")))


def read_checkpoint(
    folder: Path, repo_id: str, dataset: DatasetFacts | None, results: list[list[Record]]
) -> "Checkpoint":
    """Read and check a checkpoint, and return the facts for its card."""
    from lerobot.utils.import_utils import register_third_party_plugins

    from lerobot_bomb.checkpoints.adapters import check_adapters_fit, check_base
    from lerobot_bomb.checkpoints.checks import (
        ADAPTERS,
        check_config,
        check_finite,
        check_weights,
        policy_class,
    )
    from lerobot_bomb.checkpoints.folder import parse_config
    from lerobot_bomb.checkpoints.training import dataset_of
    from lerobot_bomb.hub.card import Checkpoint

    register_third_party_plugins()
    policy_type: Any = policy_class(folder)
    config = parse_config(folder, "cpu")
    check_config(folder, config)
    _check_processors(folder, config)
    base = None
    if config.use_peft:
        base = str(read_json(folder / ADAPTERS[0]).get("base_model_name_or_path"))
        check_base(base)
        check_adapters_fit(policy_type, config, str(folder), None)
    else:
        check_weights(folder, config, policy_type)
        check_finite(folder / WEIGHTS)
    training = _read_training(folder)
    if dataset is None and training is not None:  # it may still be where the training found it
        dataset = DatasetFacts.find(dataset_of(training.to_dict()))
    return Checkpoint(
        config=config,
        method=policy_type.method,
        repo_id=repo_id,
        training=training,
        dataset=dataset,
        results=results,
        license=config.license,
        tags=config.tags or [],
        adapters_of=base,
        num_parameters=num_parameters(folder / (WEIGHTS if base is None else ADAPTERS[1])),
    )


def num_parameters(path: Path) -> int:
    """Count the numbers in a file of weights."""
    from lerobot_bomb.checkpoints.checks import tensor_shapes

    return sum(prod(shape) for shape in tensor_shapes(path).values())


def _check_processors(folder: Path, config: "PreTrainedConfig") -> None:
    """Check that the processors load, from the folder alone."""
    from lerobot_bomb.checkpoints.folder import load_processors

    of_folder = copy(config)
    of_folder.pretrained_path = folder
    try:
        load_processors(of_folder)
    except (KeyError, TypeError, ValueError) as error:
        start = f"the processors of {folder} cannot be loaded"
        raise ValueError(f"{start}: {error}; take a checkpoint from before, or train again") from error


def portable_json(path: Path) -> str:
    """Return a config's JSON without paths of this machine."""
    return json.dumps(portable(read_json(path)), indent=4)


def portable(value: Any, key: str = "") -> Any:
    """Strip local paths from a value and from everything that it holds."""
    if isinstance(value, dict):
        return {name: portable(each, name) for name, each in value.items()}
    if isinstance(value, list):
        return [portable(each, key) for each in value]
    if not is_local_path(value) and not (key in LEFT_OUT - {"pretrained_path"} and isinstance(value, str)):
        return value
    return None if key in LEFT_OUT else Path(value).name


def _read_training(folder: Path) -> "TrainPipelineConfig | None":
    from lerobot.configs.train import TrainPipelineConfig

    if not (folder / TRAIN_CONFIG).is_file():
        return None
    return TrainPipelineConfig.from_pretrained(folder)
