"""A recording in parts that processes make apart, on any machines, and how they are joined.

    NAME.parts/0-of-8.recording/    blocks 0, 1, ... of it, as NAME.recording holds them
    NAME.recording/                 what the join makes: a short last block, more for failed episodes

A block tries episodes of its own and holds those that succeed, so the joined dataset has the bytes of one
that was recorded at once.
"""

import re
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from lerobot_bomb.data.base_recording import BaseRecording
from lerobot_bomb.data.kept_blocks import Progress, block_damage, block_path, find_gaps, reached
from lerobot_bomb.data.recorded_blocks import (
    ANY_NUMBER,
    EpisodeSource,
    record_blocks,
)
from lerobot_bomb.data.resumable import block_episodes, grow, growing
from lerobot_bomb.data.unfinished import (
    check_folders,
    check_same,
    parameters_file,
    parts_folder,
    remove_folder,
    unfinished_folder,
)

FOLDER = re.compile(r"(\d+)-of-(\d+)\.recording")


@dataclass(frozen=True)
class Part:
    """Consecutive blocks of a recording, about as many as in each other part."""

    kind: ClassVar[str] = "recording"

    recording: BaseRecording
    index: int
    number: int  # of parts

    def __str__(self) -> str:
        return f"{self.index}/{self.number}"

    def to_dict(self) -> dict[str, Any]:
        """Return the values to write as JSON."""
        return {**self.recording.to_dict(), "shard": str(self)}

    @property
    def blocks(self) -> range:
        """Return the numbers of the part's blocks; the join makes those after the last whole one."""
        whole = num_whole_blocks(self.recording)
        return range(whole * self.index // self.number, whole * (self.index + 1) // self.number)

    def folder(self, root: Path) -> Path:
        """Return the folder where the part grows, and stays until it is joined."""
        return parts_folder(root) / f"{self.index}-of-{self.number}.recording"


def num_whole_blocks(recording: BaseRecording) -> int:
    """Return the number of whole blocks of a recording in which no episode fails."""
    return recording.episodes // len(block_episodes(0))


def record_part(part: Part, root: Path, source: EpisodeSource) -> Progress | None:
    """Record a part, or its missing episodes, beside `root`; return None if the joined dataset is there.

    Raises:
        ValueError: what lies there is no part of this recording; or as `record`.
        RuntimeError: as `record`.
    """
    check_part(part, root)
    if root.exists():
        return None
    folder = part.folder(root)
    try:
        with growing(part, root, folder):
            record_blocks(part.recording, folder, source, part.blocks)
    finally:
        with suppress(OSError):
            folder.parent.rmdir()  # unless it holds something
    return reached(folder)


def check_part(part: Part, root: Path) -> None:
    """Raise a ValueError unless a part can be recorded beside `root`, with what lies there."""
    flag, most = f"--shard={part}", num_whole_blocks(part.recording)
    if part.number > most:
        scenes = f" of {part.recording.scenes} scenes" if part.recording.scenes > 1 else ""
        raise ValueError(
            f"{flag}: a part has at least {len(block_episodes(0))} episodes{scenes}, and "
            f"{part.recording.episodes} make {most} parts at most"
        )
    if root.exists():
        check_folders(part.recording, root, unfinished_folder(root), resume=True)
        return
    found = _found(root)
    if not found and unfinished_folder(root).exists():
        raise _begun_at_once(flag, root)
    for index, number in found:
        if number != part.number:
            raise ValueError(
                f"{flag}: {parts_folder(root)} holds parts of {number}; give --shard=I/{number}, or another "
                "--root"
            )
        _check_same(flag, Part(part.recording, index, number), root)


def join(recording: BaseRecording, root: Path, source: EpisodeSource) -> Progress:
    """Join the parts into the dataset at `root`, replace failed episodes, and delete the parts.

    Raises:
        ValueError: a part is missing, not finished, damaged, or of another recording; or as `record`.
        RuntimeError: as `record`.
    """
    parts = [] if root.exists() else _whole_parts(recording, root)
    folders = [part.folder(root) for part in parts]
    first = num_whole_blocks(recording)
    if parts and find_gaps(unfinished_folder(root), range(first)) != [range(first)]:
        raise _begun_at_once("--join", root)
    most = recording.episodes - reached(*folders).num_episodes
    numbers = range(first, ANY_NUMBER)
    progress = grow(
        recording,
        root,
        resume=root.exists() or unfinished_folder(root).exists(),
        write=partial(record_blocks, recording, source=source, numbers=numbers, most=most),
        layout=recording.layout,
        parts=folders,
    )
    for index, number in _found(root):
        remove_folder(Part(recording, index, number).folder(root))
    remove_folder(parts_folder(root))
    return progress


def check_no_parts(root: Path) -> None:
    """Raise a ValueError if a recording at `root` was begun in parts."""
    if _found(root) and not root.exists():
        raise ValueError(
            f"{parts_folder(root)} holds parts of a recording, of --shard; join them with --join, give "
            "another --root, or delete it"
        )


def unfinished_parts(parts: list[Part], root: Path) -> dict[Part, str]:
    """{part: its missing block, or a block's damage} of the incomplete parts."""
    found = {}
    for part in parts:
        for number in part.blocks:
            block = block_path(part.folder(root), number)
            if damage := block_damage(block):
                found[part] = f"{block.name} {damage}"
                break
    return found


def _whole_parts(recording: BaseRecording, root: Path) -> list[Part]:
    """Return the parts of a recording, once all of them are there and finished."""
    folder, found = parts_folder(root), _found(root)
    numbers = sorted({number for _, number in found})
    if not numbers:
        raise ValueError(f"--join: {folder} holds no parts; record them with --shard=0/N, --shard=1/N, ...")
    if len(numbers) > 1:
        raise ValueError(
            f"--join: {folder} holds parts of {numbers[0]} and of {numbers[1]}; delete those of one"
        )
    parts = [Part(recording, index, numbers[0]) for index in range(numbers[0])]
    for index, _ in found:
        _check_same("--join", parts[index], root)
    if unfinished := unfinished_parts(parts, root):
        said = ", ".join(f"{part} ({damage})" for part, damage in unfinished.items())
        flags = " ".join(f"--shard={part}" for part in unfinished)
        raise ValueError(f"--join: {folder} lacks parts, or blocks of them: {said}; record them with {flags}")
    return parts


def _found(root: Path) -> list[tuple[int, int]]:
    """Return (index, number of parts) of the parts that were begun."""
    matches = map(FOLDER.fullmatch, (path.name for path in parts_folder(root).glob("*.recording")))
    found = sorted((int(match[1]), int(match[2])) for match in matches if match)
    return [(index, number) for index, number in found if index < number]


def _check_same(flag: str, part: Part, root: Path) -> None:
    folder = part.folder(root)
    check_same(flag, part, parameters_file(folder), folder)


def _begun_at_once(flag: str, root: Path) -> ValueError:
    return ValueError(
        f"{flag}: {unfinished_folder(root)} holds a recording that was begun without --shard; resume without "
        "it, give another --root, or delete it"
    )
