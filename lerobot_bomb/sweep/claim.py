"""Claim on a sweep's folder, which belongs to one manifest at a time; that may grow."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from fcntl import LOCK_EX, LOCK_NB, LOCK_SH, flock
from pathlib import Path
from typing import IO

from lerobot_bomb.environments import env_type
from lerobot_bomb.sweep.manifest import NAME, Cell, Manifest, largest_divisor
from lerobot_bomb.sweep.store import Store

LOCK = "sweep.lock"  # held by every command that plays the manifest; alone by one that writes it


@contextmanager
def claimed(folder: Path, wanted: Manifest, batch_size: int | None = None) -> Iterator[Store]:
    """Hold a folder for a manifest, or for the one there with what the wanted one has more.

    Other commands may run the same manifest at the same time; stderr says so.

    Args:
        folder: made where it is missing.
        wanted: what is to be run.
        batch_size: of a cell, at most; where it is given, cells that are there count as the first episodes of
            longer ones.

    Raises:
        ValueError: episodes of other cells are there, or another command runs other cells there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / LOCK).open("a") as lock:
        is_alone = _is_alone(lock)
        flock(lock, LOCK_EX if is_alone else LOCK_SH)  # whoever writes the manifest is done
        there = Manifest.read(folder) if (folder / NAME).is_file() else None
        manifest = _grown(folder, there, wanted, batch_size)
        if is_alone and manifest != there:
            manifest.write(folder)
        flock(lock, LOCK_SH)
        if Manifest.read(folder) != manifest:
            raise ValueError(
                f"another command is playing other cells in {folder} now; wait for its end, or name another "
                "folder"
            )
        if not is_alone:
            print(f"another command plays cells of {folder} now; both share them", file=sys.stderr)
        yield Store(folder, manifest)


def _is_alone(lock: IO[str]) -> bool:
    try:
        flock(lock, LOCK_EX | LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _grown(folder: Path, there: Manifest | None, wanted: Manifest, batch_size: int | None) -> Manifest:
    """The manifest of a folder from now on: the wanted one, in which cells that are there stay as they are.

    Raises:
        ValueError: cells are there that it does not have, and episodes of that manifest have been run.
    """
    if there is None or there == wanted or Store(folder, there).is_untouched():
        return wanted
    cells = wanted.cells
    if batch_size is not None:
        cells = tuple(part for cell in cells for part in _with_rest(cell, there, batch_size))
    others = [cell for cell in there.cells if cell not in cells]
    if others:
        raise ValueError(
            f"{folder / NAME} is of another sweep: of its cells these flags lack {len(others)}, as "
            f"{others[0].command}. Name another folder; or give its flags, with more policies, tasks, "
            f"perturbations or episodes if you like; or go on with it by `lerobot-bomb sweep {folder}`"
        )
    return Manifest(cells)


def _with_rest(cell: Cell, there: Manifest, batch_size: int) -> list[Cell]:
    """Split a cell into the cells that are there from its seed on, and one of the seeds that they lack.

    Raises:
        ValueError: such a cell would start its episodes otherwise.
    """
    of_same = {each.seed: each for each in there.cells if (each.policy, each.env) == (cell.policy, cell.env)}
    parts: list[Cell] = []
    seed, end = cell.seeds.start, cell.seeds.stop
    while seed in of_same:
        parts.append(of_same[seed])
        seed = parts[-1].seeds.stop
    are_alike = all(part.batch_size == largest_divisor(part.num_episodes, batch_size) for part in parts)
    if seed > end or not parts or not are_alike:
        return [cell]
    if seed == end:
        return parts
    if env_type(cell.env_type).record.starts_by_number:
        raise ValueError(
            f"--episodes={cell.num_episodes}: cells of --env.type={cell.env_type} do not grow, because an "
            "episode starts as its number in the cell says; play more in another folder"
        )
    return [*parts, Cell(cell.policy, cell.env, seed, end - seed, largest_divisor(end - seed, batch_size))]
