"""Finished blocks in a growing folder: those that --resume keeps, and those that are missing.

Nothing else in the folder is touched: a file that another program put there stays.
"""

import hashlib
import json
import re
import shutil
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from lerobot_bomb.files import read_json

BLOCK_FILE = "block.json"  # in each block: its number and progress, and the SHA-256 of its other files
NUMBER, DIGESTS = "number", "sha256"
BLOCK = re.compile(r"block-\d{5,}")
UNFINISHED = re.compile(rf"({BLOCK.pattern}\.tmp|dataset)(\.files|\.cache)?")


@dataclass
class Progress:
    """Progress of a dataset or of one of its blocks."""

    num_episodes: int = 0
    num_frames: int = 0
    failures: list[dict[str, Any]] = field(default_factory=list)  # [{"seed": ..., "failure": ...}]

    @property
    def num_tried(self) -> int:
        return self.num_episodes + len(self.failures)

    def __add__(self, other: "Progress") -> "Progress":
        """Return the progress of both, one after the other."""
        num_frames = self.num_frames + other.num_frames
        return Progress(self.num_episodes + other.num_episodes, num_frames, self.failures + other.failures)


def block_path(folder: Path, number: int) -> Path:
    """Return where a block lies once it is finished."""
    return folder / f"block-{number:05d}"


def finished_blocks(*folders: Path) -> list[Path]:
    """Folders of the finished blocks, by their numbers; [] if the dataset's folder is missing."""
    paths = (path for folder in folders for path in folder.glob("block-*"))
    return sorted((path for path in paths if BLOCK.fullmatch(path.name)), key=_number)


def _number(block: Path) -> int:
    return int(block.name.removeprefix("block-"))


def reached(*folders: Path) -> Progress:
    """Progress of all finished blocks."""
    return sum((read_progress(block / BLOCK_FILE) for block in finished_blocks(*folders)), start=Progress())


def episodes_before(folder: Path, number: int) -> int:
    """Return how many episodes are in a folder's finished blocks of smaller numbers."""
    blocks = [block for block in finished_blocks(folder) if _number(block) < number]
    return sum(read_progress(block / BLOCK_FILE).num_episodes for block in blocks)


def finish_block(unfinished: Path, block: Path, progress: Progress) -> None:
    """Give a finished block its name and its counts."""
    said = {NUMBER: _number(block), **asdict(progress), DIGESTS: _digests(unfinished)}
    write_json(unfinished / BLOCK_FILE, said)
    unfinished.rename(block)


def find_gaps(folder: Path, numbers: range) -> list[range]:
    """Return the missing blocks' numbers, joined into ranges."""
    there = [number for number in map(_number, finished_blocks(folder)) if number in numbers]
    starts, ends = [numbers.start, *(number + 1 for number in there)], [*there, numbers.stop]
    return [range(start, end) for start, end in zip(starts, ends, strict=True) if start < end]


def damaged_blocks(folder: Path, numbers: range) -> dict[Path, str]:
    """{block: its damage} of all blocks up to the last one."""
    last = max(map(_number, finished_blocks(folder)), default=-1)
    blocks = (block_path(folder, number) for number in range(numbers.start, last + 1))
    return {block: damage for block in blocks if (damage := block_damage(block))}


def block_damage(block: Path) -> str | None:
    """Return what is wrong with a block; None if nothing is."""
    if not block.exists():
        return "is missing"
    try:
        values = read_json(block / BLOCK_FILE)
        Progress(**_of_progress(values))
        number, expected = int(values[NUMBER]), dict(values[DIGESTS])
    except (FileNotFoundError, ValueError, KeyError, TypeError):
        return f"holds no {BLOCK_FILE} that can be read"
    if number != _number(block):
        return f"is block {number}"
    found = _digests(block)
    for name, digest in expected.items():
        if found.get(name) != digest:
            return f"holds no {name}" if name not in found else f"holds a damaged {name}"
    return None


def _digests(block: Path) -> dict[str, str]:
    """{path in a block: SHA-256} of all its files."""
    digests = {}
    for path in sorted(block.rglob("*")):
        if path.is_file():
            with path.open("rb") as file:
                digests[path.relative_to(block).as_posix()] = hashlib.file_digest(file, "sha256").hexdigest()
    return digests


def read_progress(path: Path) -> Progress:
    """Read the progress from a block's or a dataset's file.

    Raises:
        ValueError: it holds none.
    """
    try:
        return Progress(**_of_progress(read_json(path)))
    except KeyError as error:
        raise ValueError(f"{path} has no {error}") from None


def _of_progress(values: dict[str, Any]) -> dict[str, Any]:
    return {each.name: values[each.name] for each in fields(Progress)}


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Write a file that is complete whenever it exists."""
    unfinished = path.with_suffix(".tmp")
    unfinished.write_text(json.dumps(values, indent=1))
    unfinished.replace(path)


def remove(paths: Iterable[Path]) -> None:
    """Delete files, folders and links, as far as possible."""
    for path in paths:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            with suppress(OSError):
                path.unlink()
