"""Training of a checkpoint, as its files tell it."""

from pathlib import Path
from typing import Any

from lerobot_bomb.checkpoints.names import TRAIN_CONFIG
from lerobot_bomb.data.resumable import default_root
from lerobot_bomb.files import read_json


def read_train_config(checkpoint: Path) -> dict[str, Any]:
    """Return what lerobot-train was given; empty if the checkpoint does not say."""
    path = checkpoint / TRAIN_CONFIG
    return read_json(path) if path.is_file() else {}


def dataset_of(train_config: dict[str, Any]) -> Path | None:
    """Folder of the dataset, which may be gone; None: not known.

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
