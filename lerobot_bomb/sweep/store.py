"""Store of what is done in a sweep: a folder that any number of workers share.

A cell is finished where `cells/KEY.jsonl` holds all its episodes; a worker that runs one holds the lock on
`cells/KEY.lock`, which the system takes from it if it is killed. What such a worker left is run again,
three times at most in one run: a sweep that was stopped, with workers that may outlive it by moments, is no
failed attempt.
"""

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from fcntl import LOCK_EX, LOCK_NB, flock
from pathlib import Path
from uuid import uuid4

from lerobot_bomb.files import append_line, written_whole
from lerobot_bomb.sweep.manifest import Cell, Manifest

MAX_ATTEMPTS = 3
REFUSED = 3  # exit code of a worker that plays nothing; the last line of its log says why
POLL_S = 0.5  # between two looks at what other processes have done
CELLS, RESULTS, ERRORS = "cells", "results.jsonl", "errors.jsonl"


@dataclass(frozen=True)
class EpisodeError:
    """An episode that has no result, which is no failure of the task."""

    cell: str
    seed: int
    error: str
    command: str  # plays it again


def unplayed_seeds(cell: Cell, lines: Sequence[str | bytes], errors: Sequence[EpisodeError]) -> list[int]:
    """Seeds of a cell that have neither an error nor as many records as the others, one for each task.

    Raises:
        ValueError: a line is no record.
    """
    try:
        counts = Counter(json.loads(line)["spec"]["seed"] for line in lines)
    except (KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"a line is no episode: {error!r}") from None
    failed = {error.seed for error in errors}
    most = max(counts.values(), default=1)
    return [seed for seed in cell.seeds if seed not in failed and counts[seed] < most]


class Store:
    """The folder of a sweep.

    Args:
        folder: where `manifest` lies.
        manifest: what is run.
        run: names the command whose workers' attempts count together; None: a new one.
    """

    def __init__(self, folder: Path, manifest: Manifest, run: str | None = None) -> None:
        self.folder, self.manifest, self.run = folder, manifest, run or uuid4().hex
        self._whole: dict[Path, tuple[int, int]] = {}  # files that were read and found whole
        (folder / CELLS).mkdir(parents=True, exist_ok=True)

    def file(self, cell: Cell, ending: str) -> Path:
        """Return a cell's file: finished records (.jsonl) or unfinished (.part), errors, attempts, lock."""
        return self.folder / CELLS / f"{cell.key}.{ending}"

    def is_finished(self, cell: Cell) -> bool:
        """Return True if the file of its records is there and whole; a crash can cut it off."""
        path = self.file(cell, "jsonl")
        try:
            state = path.stat()
        except FileNotFoundError:
            return False
        version = (state.st_mtime_ns, state.st_size)
        if self._whole.get(path) != version and self._is_whole(cell):
            self._whole[path] = version
        return self._whole.get(path) == version

    def _is_whole(self, cell: Cell) -> bool:
        *lines, rest = _read(self.file(cell, "jsonl")).split(b"\n")
        try:
            return not rest and not unplayed_seeds(cell, lines, self.errors(cell))
        except (ValueError, TypeError):  # of either file
            return False

    def is_untouched(self) -> bool:
        """Return True if no episode has been run, with a record or with an error, and none is running."""
        cells = self.manifest.cells
        return not any(map(self.has_begun, cells)) and all(map(self._is_free, cells))

    def has_begun(self, cell: Cell) -> bool:
        """Return True if an episode has been run, with a record or with an error, or is running."""
        return any(self.file(cell, ending).is_file() for ending in ("jsonl", "part", "errors"))

    def _is_free(self, cell: Cell) -> bool:
        with self.claimed(cell) as is_mine:
            return is_mine

    def begin(self, cell: Cell) -> bool:
        """Count an attempt; give the cell up, and return False, if there were enough that were killed."""
        if self._num_attempts(cell) >= MAX_ATTEMPTS:
            self.give_up(cell, f"{MAX_ATTEMPTS} workers ended while they played it")
            return False
        append_line(self.file(cell, "attempts"), self.run)
        return True

    def fail(self, cell: Cell, reason: str) -> None:
        """Give the cell up, if the attempt that ended so was the last."""
        if self._num_attempts(cell) >= MAX_ATTEMPTS:
            self.give_up(cell, f"{reason}; {MAX_ATTEMPTS} attempts")

    def lost(self, cell: Cell, reason: str) -> None:
        """Note why the worker ended that ran the cell, unless another has finished it or runs it now."""
        with self.claimed(cell) as is_mine:
            if is_mine and not self.is_finished(cell):
                self.fail(cell, reason)

    def in_turn(self, cells: Sequence[Cell]) -> list[Cell]:
        """Return the cells to be run, those first that no worker has died of, nor of their policy."""
        attempts = {cell: self._num_attempts(cell) for cell in cells}
        of_policy: Counter[tuple[str, ...]] = Counter()
        for cell, number in attempts.items():
            of_policy[cell.policy] += number
        return sorted(cells, key=lambda cell: (of_policy[cell.policy], attempts[cell]))

    def _num_attempts(self, cell: Cell) -> int:
        """Count this run's attempts at the cell."""
        return _read(self.file(cell, "attempts")).split().count(self.run.encode())

    def give_up(self, cell: Cell, reason: str) -> None:
        """Give a cell up: no worker runs it any more."""
        with written_whole(self.file(cell, "given_up")) as (path,):
            path.write_text(reason)

    def is_over(self, cell: Cell) -> bool:
        """Return True if the cell is finished or given up."""
        return self.is_finished(cell) or self.file(cell, "given_up").is_file()

    def begin_again(self, cells: Sequence[Cell]) -> None:
        """Forget what became of those that were given up or in which episodes had errors."""
        for cell in cells:
            if any(self.file(cell, ending).is_file() for ending in ("given_up", "errors")):
                with self.claimed(cell) as is_mine:
                    if is_mine:
                        for ending in ("attempts", "given_up", "errors", "jsonl"):
                            self.file(cell, ending).unlink(missing_ok=True)

    @contextmanager
    def claimed(self, cell: Cell) -> Iterator[bool]:
        """Yield True and keep other workers off the cell; yield False if another one runs it."""
        with self.file(cell, "lock").open("w") as lock:
            try:
                flock(lock, LOCK_EX | LOCK_NB)
            except BlockingIOError:
                yield False
                return
            yield True

    def finish(self, cell: Cell, lines: list[str], errors: list[EpisodeError]) -> None:
        """Keep a cell's records, by seed, and the errors of seeds without one."""
        self.file(cell, "errors").unlink(missing_ok=True)  # of an attempt that could not be written
        if errors:
            with written_whole(self.file(cell, "errors")) as (path,):
                path.write_text("".join(json.dumps(asdict(error)) + "\n" for error in errors))
        with written_whole(self.file(cell, "jsonl")) as (path,):
            path.write_text("".join(f"{line}\n" for line in lines))
        self.file(cell, "part").unlink(missing_ok=True)

    def num_played(self, cells: Sequence[Cell]) -> int:
        """Count episodes that have a record or an error, also in cells that are running."""
        endings = ("jsonl", "part", "errors")
        paths = [self.file(cell, ending) for cell in cells for ending in endings]
        return sum(_read(path).count(b"\n") for path in paths)

    def merge(self) -> None:
        """Write all finished cells' records in the order of the manifest, and all errors."""
        with (self.folder / CELLS / "merge.lock").open("w") as lock:
            flock(lock, LOCK_EX)  # who writes last has read what all that wrote before had finished
            for name, ending in ((RESULTS, "jsonl"), (ERRORS, "errors")):
                paths = [self.file(cell, ending) for cell in self.manifest.cells if self.is_finished(cell)]
                with written_whole(self.folder / name) as (path,):
                    path.write_bytes(b"".join(map(_read, paths)))

    def lines(self) -> list[str]:
        """Describe what is finished, and what is missing and why."""
        cells = self.manifest.cells
        finished = [cell for cell in cells if self.is_finished(cell)]
        errors = [error for cell in finished for error in self.errors(cell)]
        episodes = sum(cell.num_episodes for cell in finished) - len(errors)
        text = [
            f"{self.folder / RESULTS}: {episodes} of {self.manifest.num_episodes} episodes, "
            f"{len(finished)} of {len(cells)} cells"
        ]
        if errors:
            text.append(
                f"{self.folder / ERRORS}: {len(errors)} episodes have no result, an error ended them:"
            )
            causes = Counter(error.error for error in errors)
            text += [f"  {number} x {cause}" for cause, number in causes.most_common()]
        given_up = [cell for cell in cells if not self.is_finished(cell) and self.is_over(cell)]
        for cell in given_up:
            why = self.file(cell, "given_up").read_text().splitlines()
            text += [f"given up: {cell.command}", *(f"  {line}" for line in why)]
        if errors or given_up:
            text.append(f"to play them again: lerobot-bomb sweep {self.folder} --retry")
        if given_up and self.is_untouched():
            text.append("nothing was played, so the folder takes a sweep with other flags, too")
        others = self._of_other_manifests()
        if others:
            text.append(f"not counted, for the manifest has changed: {len(others)} cells, as {others[0]}")
        return text

    def errors(self, cell: Cell) -> list[EpisodeError]:
        """Return the errors of a finished cell."""
        return [EpisodeError(**json.loads(line)) for line in _read(self.file(cell, "errors")).splitlines()]

    def _of_other_manifests(self) -> list[Path]:
        known = {cell.key for cell in self.manifest.cells}
        return [path for path in sorted((self.folder / CELLS).glob("*.jsonl")) if path.stem not in known]


def _read(path: Path) -> bytes:
    """Read a file; empty where there is none: another process may remove it at any moment."""
    try:
        return path.read_bytes()
    except FileNotFoundError:
        return b""
