"""Files to which processes append lines."""

import os
from contextlib import suppress
from fcntl import LOCK_EX, flock
from pathlib import Path


def append_line(path: Path | str, line: str) -> None:
    r"""Add a line, all of it or nothing, to a file that other processes append to as well.

    It starts on a line of its own, even where something left the last one without its "\n".

    Raises:
        OSError: the disk is full, or the file cannot be written; it holds whole lines then.
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
    """Make the file and its folder, unless they exist.

    Raises:
        OSError: `append_line` could not write it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+b") as file:
        flock(file, LOCK_EX)


def _write_all(file: int, data: bytes) -> None:
    """As os.write, which on a full disk writes a part and says so in its result only."""
    while data:
        data = data[os.write(file, data) :]
