"""Cells that worker processes run on this machine."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from typing import IO

from tqdm import tqdm

from lerobot_bomb.sweep.manifest import Cell
from lerobot_bomb.sweep.processes import num_cores, visible_gpus, worker_environments
from lerobot_bomb.sweep.store import POLL_S, REFUSED, Store

# -P: nothing in the folder that the user is in stands for a module of the same name
PYTHON = (sys.executable, "-P", "-m")
MAX_ENDED = 3


def progress(store: Store, cells: Sequence[Cell]) -> Iterator[bool]:
    """Show how far the cells are until all are over, and yield whether they are further than before.

    The records of cells that have been finished are merged, whatever ends this process later.
    """
    total = sum(cell.num_episodes for cell in cells)
    left, num_before = _not_over(store, cells)  # what is over is not read again
    has_played, num_unmerged = False, len(cells)
    with tqdm(total=total, initial=num_before + store.num_played(left), unit=" episodes") as bar:
        while left:
            yield has_played
            time.sleep(POLL_S)
            left, num_more = _not_over(store, left)
            num_before += num_more
            more = num_before + store.num_played(left) - bar.n
            if has_played := more != 0:
                bar.update(more)
            if len(left) != num_unmerged:
                num_unmerged = len(left)
                store.merge()


def _not_over(store: Store, cells: Sequence[Cell]) -> tuple[list[Cell], int]:
    """Return the cells that are to be run, and how many episodes of the others have been."""
    is_over = {cell: store.is_over(cell) for cell in cells}
    over = [cell for cell in cells if is_over[cell]]
    return [cell for cell in cells if not is_over[cell]], store.num_played(over)


class WorkerProcess:
    """A worker, and the cell that it runs, which it says through a pipe."""

    def __init__(self, command: Sequence[str], environment: dict[str, str], log: IO[bytes]) -> None:
        said, told = os.pipe()
        os.set_blocking(said, False)
        self._said = os.fdopen(said, "rb", buffering=0)
        self._process = subprocess.Popen(
            [*command, str(told)],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=subprocess.STDOUT,
            pass_fds=[told],
        )
        os.close(told)
        self._unread = b""
        self._end = ""  # how it was ended from here
        self.cell = ""  # its key; "": none
        self.since = time.monotonic()

    def look(self) -> str | None:
        """Read which cell is run; return how the worker ended, None while it runs."""
        code = self._process.poll()
        self._unread += self._said.read() or b""
        *cells, self._unread = self._unread.split(b"\n")
        if cells:
            self.cell, self.since = cells[-1].decode(), time.monotonic()
        return None if code is None else self._end or ended(code)

    @property
    def is_refused(self) -> bool:
        """True if the process ended because flags are wrong."""
        return self._process.returncode == REFUSED

    def kill(self, reason: str = "") -> None:
        """End it, whatever it does: code that is not Python's heeds nothing else."""
        self._end = reason
        self._process.kill()

    def close(self) -> None:
        """Wait for its end."""
        self._process.wait()
        if self._process.stdin is not None:
            self._process.stdin.close()
        self._said.close()


def ended(code: int) -> str:
    """Describe how a process ended, from Popen's return code."""
    if code >= 0:
        return f"its process ended with exit code {code}"
    cause = {signal.SIGKILL: ", as where memory is short", signal.SIGSEGV: ", a fault of native code"}
    number = signal.Signals(-code)
    return f"its process was ended by {number.name}{cause.get(number, '')}"


class Workers:
    """The worker processes of one command, each started anew when it has ended.

    Args:
        store: what is run.
        command: starts a worker.
        environments: of each.
        timeout_s: of a cell; None: none.
    """

    def __init__(
        self,
        store: Store,
        command: Sequence[str],
        environments: Sequence[dict[str, str]],
        timeout_s: int | None,
    ) -> None:
        self._store, self._command, self._environments = store, command, environments
        self._timeout_s = timeout_s
        self._cells = {cell.key: cell for cell in store.manifest.cells}
        self._path = store.folder / "workers.log"
        self._log = self._path.open("ab")
        self._start = self._log.tell()  # what is before is of earlier commands
        self._workers: list[WorkerProcess] = []
        self._num_idle_ends = 0  # of workers that had begun no cell, since an episode was played

    def look(self, has_played: bool) -> None:
        """Start those that are missing, end those whose cell takes too long.

        Raises:
            RuntimeError: they end before they play, or refuse to; the message says why.
        """
        self._num_idle_ends = 0 if has_played else self._num_idle_ends
        for number, worker in enumerate(self._workers):
            end = worker.look()
            if end is not None:
                self._end(worker, end)
                self._workers[number] = self._started(number)
            elif worker.cell and self._timeout_s and time.monotonic() - worker.since > self._timeout_s:
                worker.kill(f"not finished after {self._timeout_s} s (--timeout)")
        self._workers += map(self._started, range(len(self._workers), len(self._environments)))

    def _started(self, number: int) -> WorkerProcess:
        return WorkerProcess(self._command, self._environments[number], self._log)

    def _end(self, worker: WorkerProcess, end: str) -> None:
        worker.close()
        if worker.is_refused:
            raise RuntimeError(self._last_line() or end)
        if worker.cell:
            self._log.write(f"\n{worker.cell}: {end}\n".encode())
            self._log.flush()
            self._store.lost(self._cells[worker.cell], end)
            return
        self._num_idle_ends += 1
        if self._num_idle_ends > MAX_ENDED * len(self._environments):
            reason = "; ".join(filter(None, (end, self._last_line())))
            raise RuntimeError(f"workers end before they play: {reason}; see {self._path}")

    def _last_line(self) -> str:
        """The last line that this command's workers have said, '' where they said nothing."""
        said = self._path.read_bytes()[self._start :].decode(errors="replace").split("\n")
        return next((line.strip() for line in reversed(said) if line.strip()), "")

    def close(self) -> None:
        """End all."""
        for worker in self._workers:
            worker.kill()
        for worker in self._workers:
            worker.close()
        self._log.close()


def play(store: Store, part: str, num_workers: int, timeout_s: int | None = None) -> None:
    """Run a part of the cells: start workers, and start those anew that ended.

    Raises:
        RuntimeError: they end before they play, or refuse to; the message says why.
    """
    cells = store.manifest.part(part)
    num_workers = min(num_workers, len(cells))
    environments = worker_environments(num_workers, os.environ, num_cores(), visible_gpus(os.environ))
    command = [*PYTHON, "lerobot_bomb.sweep", str(store.folder), part, store.run]
    workers = Workers(store, command, environments, timeout_s)
    try:
        for has_played in progress(store, cells):
            workers.look(has_played)
    finally:
        workers.close()
