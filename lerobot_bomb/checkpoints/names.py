"""Names of a checkpoint's files, ids on the Hub, and paths that only this machine has."""

import re
from pathlib import Path
from typing import Any

CONFIG, TRAIN_CONFIG, WEIGHTS = "config.json", "train_config.json", "model.safetensors"
PREPROCESSOR = "policy_preprocessor.json"

# processor steps that change a policy's inputs on purpose
BLANK_IMAGES, REPLACE_TASKS = "bomb_blank_images", "bomb_replace_tasks"

# what to do with adapters whose base is on one machine only
TO_PUBLISH = (
    "publish that first (lerobot-bomb push) and train with --policy.path of its name, or publish both as one "
    "checkpoint (lerobot-bomb checkpoint merge)"
)


def check_checkpoint(path: Path) -> None:
    """Raise a ValueError unless a folder has the files of a checkpoint, which are not read."""
    if path.is_file():
        raise ValueError(f"--policy.path={path} is a file; give the folder of a checkpoint")
    if not path.is_dir():
        raise ValueError(f"--policy.path={path}: there is no such folder; give one that holds a checkpoint")
    missing = [name for name in (CONFIG, PREPROCESSOR) if not (path / name).is_file()]
    if missing:
        raise ValueError(
            f"--policy.path={path} holds no {missing[0]}, so it is no checkpoint of a policy; "
            "give the folder that lerobot-train names pretrained_model"
        )


def is_hub_id(name: object) -> bool:
    """Return True if the text has the form USER/NAME and is no folder here."""
    text = str(name)
    return re.fullmatch(r"\w[\w.-]*/[\w.-]+", text) is not None and not Path(text).exists()


def local_file(checkpoint: Path | str, revision: str | None, name: str) -> Path | None:
    """Return a file of a folder, or of a downloaded repository of the Hub; None if there is none."""
    if Path(checkpoint).is_dir():
        path = Path(checkpoint) / name
        return path if path.is_file() else None
    from huggingface_hub import try_to_load_from_cache  # a second

    cached = try_to_load_from_cache(str(checkpoint), name, revision=revision)
    return Path(cached) if isinstance(cached, str) else None


def is_local_path(value: object) -> bool:
    """Return True if a text names a place on this machine."""
    if not isinstance(value, str | Path) or not str(value):
        return False
    text = str(value)
    return text.startswith(("/", "~", "./", "../")) or ("/" in text and Path(text).exists())


def has_local_path(value: Any) -> bool:
    """Return True if anything inside lists and dicts names a place on this machine."""
    if isinstance(value, dict):
        return any(map(has_local_path, value.values()))
    if isinstance(value, list | tuple):
        return any(map(has_local_path, value))
    return is_local_path(value)
