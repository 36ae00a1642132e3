"""Files that appear under their names at once, complete."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lerobot_bomb.flags import check_link


def check_writable(flag: str, path: Path) -> None:
    """Raise a ValueError unless a file can be made at the path that a flag gives."""
    check_link(flag, path)
    if path.is_dir() or not os.access(path.parent, os.W_OK):
        raise ValueError(f"{flag}={path} cannot be written; give a file in a folder that exists")


def check_new_folder(flag: str, path: Path) -> None:
    """Raise a ValueError if there is something at the path that a flag gives."""
    check_link(flag, path)
    if path.exists():
        raise ValueError(f"{flag}={path} exists already; name a new folder or delete it")


@contextmanager
def written_whole(*paths: Path) -> Iterator[list[Path]]:
    """Give paths to write to; when nothing was raised, what lies there gets the names `paths`.

    All lie in one folder, which is made. What a kill leaves is in a hidden folder there.
    """
    folder = paths[0].parent
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".unfinished-", dir=folder) as temporary:
        unfinished = [Path(temporary) / path.name for path in paths]
        yield unfinished
        for source, path in zip(unfinished, paths, strict=True):
            source.replace(path)
