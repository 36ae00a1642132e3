"""Training of a checkpoint, as its files describe it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lerobot_bomb.checkpoints.names import CONFIG, TRAIN_CONFIG
from lerobot_bomb.data.resumable import default_root
from lerobot_bomb.files import read_json


def read_train_config(checkpoint: Path) -> dict[str, Any]:
    """Return the config of the training; empty if the checkpoint does not have it."""
    path = checkpoint / TRAIN_CONFIG
    return read_json(path) if path.is_file() else {}


def dataset_of(train_config: Mapping[str, Any]) -> Path | None:
    """Return the folder of the training's dataset, which may be gone; None if unknown.

    Raises:
        ValueError: the config names no dataset as lerobot-train does.
    """
    dataset = train_config.get("dataset") or {}
    is_named = isinstance(dataset, dict) and all(
        isinstance(dataset.get(name), str | None) for name in ("root", "repo_id")
    )
    if not is_named:
        raise ValueError(f"{TRAIN_CONFIG}: its dataset has no root and repo_id as lerobot-train writes them")
    if dataset.get("root"):
        return Path(dataset["root"])
    return default_root(dataset["repo_id"]) if dataset.get("repo_id") else None


def trained_image_size(checkpoint: Path) -> int | None:
    """Return the side of the images that a checkpoint was trained on; None where its files do not say."""
    try:
        features = read_json(checkpoint / CONFIG)["input_features"].values()
        return next((each["shape"][-1] for each in features if each["type"] == "VISUAL"), None)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, IndexError):
        return None  # refused when it is loaded
