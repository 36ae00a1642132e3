"""Checkpoints that come with the package: small policies that place stones, trained from nothing.

Wherever LeRobot's commands and ours take a checkpoint, `bomb:NAME` is one of these.
"""

from pathlib import Path

from lerobot_bomb.checkpoints.names import CONFIG
from lerobot_bomb.results.names import SHIPPED_PREFIX

FOLDER = Path(__file__).parent / "weights"


def shipped_names() -> list[str]:
    """Return the names that can follow `bomb:`."""
    return sorted(path.parent.name for path in FOLDER.glob(f"*/{CONFIG}"))


def shipped_checkpoint(name: str) -> Path:
    """Return a shipped checkpoint's folder, as lerobot-train's `pretrained_model`; do not write to it.

    Raises:
        ValueError: there is none of this name.
    """
    if name not in shipped_names():
        raise ValueError(
            f"no checkpoint {name!r} comes with this package; choose one of: {', '.join(shipped_names())}"
        )
    return FOLDER / name


def checkpoint_path(text: str) -> str:
    """Return a checkpoint's path: for `bomb:NAME` its folder, anything else unchanged.

    Raises:
        ValueError: no checkpoint of this name comes with the package.
    """
    if not text.startswith(SHIPPED_PREFIX):
        return text
    return str(shipped_checkpoint(text.removeprefix(SHIPPED_PREFIX)))
