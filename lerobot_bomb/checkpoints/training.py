"""What a checkpoint says of its training."""

from pathlib import Path
from typing import Any

from lerobot_bomb.checkpoints.names import TRAIN_CONFIG
from lerobot_bomb.data.resumable import default_root
from lerobot_bomb.files import read_json


def read_train_config(checkpoint: Path) -> dict[str, Any]:
    """What lerobot-train was given; empty if the checkpoint does not say."""
    path = checkpoint / TRAIN_CONFIG
    return read_json(path) if path.is_file() else {}


def dataset_of(train_config: dict[str, Any]) -> Path | None:
    """Folder of the dataset, which may be gone; None: not known."""
    dataset = train_config.get("dataset") or {}
    if dataset.get("root"):
        return Path(dataset["root"])
    return default_root(dataset["repo_id"]) if dataset.get("repo_id") else None
