"""The finished blocks in a growing folder: what --resume keeps of them, and what is missing.

Nothing else in the folder is touched: a file that another program put there stays.
"""

import hashlib
import json
import re
import shutil
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from lerobot_bomb.files import read_json

BLOCK_FILE = "block.json"  # in each block: the progress up to its end, and the SHA-256 of its other files
DIGESTS = "sha256"
BLOCK = re.compile(r"block-\d{5,}")
UNFINISHED = re.compile(rf"({BLOCK.pattern}\.tmp|dataset)(\.files|\.cache)?")


@dataclass
class Progress:
    """Progress of a growing dataset."""

    num_episodes: int = 0
    num_frames: int = 0
    failures: list[dict[str, Any]] = field(default_factory=list)  # [{"seed": ..., "failure": ...}]

    @property
    def num_tried(self) -> int:
        return self.num_episodes + len(self.failures)


@dataclass(frozen=True)
class Gap:
    """Blocks in a row that are still to be made."""

    progress: Progress  # up to where they begin; grows with them
    end: int  # episodes of the dataset up to their end

    @property
    def num_missing(self) -> int:
        return self.end - self.progress.num_episodes


def block_path(folder: Path, number: int) -> Path:
    """Return where a block lies once it is finished."""
    return folder / f"block-{number:05d}"


def finished_blocks(folder: Path) -> list[Path]:
    """Folders of the finished blocks, in order; none where the folder itself is missing."""
    return sorted(path for path in folder.glob("block-*") if BLOCK.fullmatch(path.name))


def reached(folder: Path) -> Progress:
    """Progress up to the end of the last finished block."""
    return read_progress(finished_blocks(folder)[-1] / BLOCK_FILE)


def finish_block(unfinished: Path, block: Path, progress: Progress) -> None:
    """Give a block its name, with the progress up to its end and what its files are."""
    write_json(unfinished / BLOCK_FILE, {**asdict(progress), DIGESTS: _digests(unfinished)})
    unfinished.rename(block)


def find_gaps(folder: Path, num_episodes: int, block_episodes: int) -> list[Gap]:
    """Return the gaps before, between and after the finished blocks of a dataset of so many episodes."""
    gaps: list[Gap] = []
    progress = Progress()
    for number, start in enumerate(range(0, num_episodes, block_episodes)):
        end = min(start + block_episodes, num_episodes)
        block = block_path(folder, number)
        if block.exists():
            progress = read_progress(block / BLOCK_FILE)
        elif gaps and gaps[-1].end == start:
            gaps[-1] = replace(gaps[-1], end=end)
        else:
            gaps.append(Gap(progress, end))
    return gaps


def damaged_blocks(folder: Path, num_episodes: int, block_episodes: int) -> dict[Path, str]:
    """{block: what is wrong with it} of those up to the last one that is there."""
    numbers = [int(block.name.removeprefix("block-")) for block in finished_blocks(folder)]
    damaged = {}
    for number in range(max(numbers, default=-1) + 1):
        block = block_path(folder, number)
        if damage := _damage(block, min((number + 1) * block_episodes, num_episodes)):
            damaged[block] = damage
    return damaged


def _damage(block: Path, end: int) -> str | None:
    """Describe what is wrong with a block that ends with this episode of the dataset; None: nothing."""
    if not block.exists():
        return "is missing"
    try:
        values = read_json(block / BLOCK_FILE)
        num_episodes, expected = Progress(**_of_progress(values)).num_episodes, dict(values[DIGESTS])
    except (FileNotFoundError, ValueError, KeyError, TypeError):
        return f"holds no {BLOCK_FILE} that can be read"
    if num_episodes != end:
        return f"ends with episode {num_episodes} instead of {end}"
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
    """Progress from a block's or a dataset's file.

    Raises:
        ValueError: it holds none.
    """
    try:
        return Progress(**_of_progress(read_json(path)))
    except KeyError as error:
        raise ValueError(f"{path} has no {error}") from None


def _of_progress(values: dict[str, Any]) -> dict[str, Any]:
    return {of.name: values[of.name] for of in fields(Progress)}


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
