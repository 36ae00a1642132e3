"""Files: read though they may be damaged, written whole or not at all, appended to by several processes."""

import errno
import json
import os
import re
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from fcntl import LOCK_EX, flock
from itertools import chain, count
from pathlib import Path
from typing import Any

from lerobot_bomb.flags import check_link

MAX_DEPTH = 100  # of lists and objects in one another; what goes deeper ends in a RecursionError somewhere
FULL = (errno.ENOSPC, errno.EDQUOT)  # the disk, or this user's share of it
MAX_NAME = 100  # characters of a file's name that is made of a text


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object from a file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file holds something else, is truncated, or is nested too deep.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path.parent} has no {path.name}")
    try:
        values = json.loads(path.read_bytes())
        _check_depth(values, MAX_DEPTH)
    except RecursionError:
        raise ValueError(f"{path} is nested more than {MAX_DEPTH} levels deep") from None
    except ValueError as error:
        raise ValueError(f"{path} is not JSON, or truncated: {error}") from None
    if not isinstance(values, dict):
        raise ValueError(f"{path} is not a JSON object")
    return values


def _check_depth(values: Any, levels: int) -> None:
    """Raise a RecursionError if lists and objects are nested deeper than `levels`."""
    if not isinstance(values, dict | list):
        return
    if levels == 0:
        raise RecursionError
    for value in values.values() if isinstance(values, dict) else values:
        _check_depth(value, levels - 1)


def file_names(texts: Sequence[str]) -> list[str]:
    """Return a different file name for each text, of letters, digits, '_', '-' and '.', whatever the case.

    No name begins with a '.', so none is hidden, and none is '.' or '..'.
    """
    names: list[str] = []
    for text in texts:
        readable = re.sub(r"[^\w.-]+", "-", text, flags=re.ASCII)[:MAX_NAME].strip("-.") or "unnamed"
        numbered = (f"{readable}-{number}" for number in count(2))
        taken = {name.lower() for name in names}
        names.append(next(name for name in chain([readable], numbered) if name.lower() not in taken))
    return names


def check_writable(flag: str, path: Path) -> None:
    """Raise a ValueError unless a file can be made at the path that a flag gives."""
    check_link(flag, path)
    if path.is_dir() or not os.access(path.parent, os.W_OK):
        raise ValueError(f"{flag}={path} cannot be written; give a file in a folder that exists")


def check_new_file(flag: str, path: Path) -> None:
    """Raise a ValueError unless a file can be made at the path that a flag gives, where there is none."""
    if path.exists():
        raise ValueError(f"{flag}={path} exists already; name a new file")
    check_writable(flag, path)


def check_new_folder(flag: str, path: Path) -> None:
    """Raise a ValueError if there is something at the path that a flag gives."""
    check_link(flag, path)
    if path.exists():
        raise ValueError(f"{flag}={path} exists already; name a new folder")


@contextmanager
def written_whole(*paths: Path) -> Iterator[list[Path]]:
    """Yield paths to write to; if nothing is raised, the files get the names `paths`.

    All lie in one folder, which is created. A process that is killed leaves a hidden folder there.

    Raises:
        OSError: the disk is full; names the way out. Earlier files at these paths are still there.
    """
    folder = paths[0].parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".unfinished-", dir=folder) as temporary:
            unfinished = [Path(temporary) / path.name for path in paths]
            yield unfinished
            # else a crash of the machine could leave a name with nothing in it
            for path in (each for source in unfinished for each in (source, *source.rglob("*"))):
                if not path.is_symlink():
                    _sync(path)
            for source, path in zip(unfinished, paths, strict=True):
                source.replace(path)
            _sync(folder)
    except OSError as error:
        if error.errno not in FULL:
            raise
        raise OSError(
            error.errno,
            f"{', '.join(map(str, paths))} could not be written ({error.strerror}); what was there before "
            "stays. Make room, and give the same command again",
        ) from error


def _sync(path: Path) -> None:
    """Flush a file, or a folder's list of names, to the disk."""
    file = os.open(path, os.O_RDONLY)
    try:
        os.fsync(file)
    except OSError as error:
        if error.errno != errno.EINVAL or not path.is_dir():  # of file systems that cannot sync folders
            raise
    finally:
        os.close(file)


def append_line(path: Path | str, line: str) -> None:
    r"""Add a line, all of it or nothing, to a file that other processes append to as well.

    It starts a new line, even if the file does not end with "\n".

    Raises:
        OSError: the disk is full, or the file cannot be written; it still holds whole lines.
    """
    file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
    try:
        flock(file, LOCK_EX)
        size = os.fstat(file).st_size
        is_cut_off = size > 0 and os.pread(file, 1, size - 1) != b"\n"
        try:
            _write_all(file, f"{'\n' if is_cut_off else ''}{line}\n".encode())
        except OSError:
            with suppress(OSError):  # a device cannot be cut
                os.ftruncate(file, size)
            raise
    finally:
        os.close(file)


def check_appendable(path: Path) -> None:
    """Check that a file can be appended to; make its folder, unless it exists.

    Raises:
        OSError: `append_line` could not write the file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists() or path.is_symlink():
        with path.open("a+b") as file:
            flock(file, LOCK_EX)
    else:
        tempfile.TemporaryFile(dir=path.parent).close()


def _write_all(file: int, data: bytes) -> None:
    """Write all bytes: on a full disk os.write writes a part, and only its result says so."""
    while data:
        data = data[os.write(file, data) :]
