"""Cells played by worker processes on this machine."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

from tqdm import tqdm

from lerobot_bomb.sweep.manifest import Cell
from lerobot_bomb.sweep.processes import num_cores, visible_gpus, worker_environments
from lerobot_bomb.sweep.store import POLL_S, REFUSED, Store

# -P: nothing in the folder that the user is in stands for a module of the same name
PYTHON = (sys.executable, "-P", "-m")
MAX_ENDED = 3


def progress(store: Store, cells: Sequence[Cell]) -> Iterator[bool]:
    """Until all cells are over, show how far they are, and say whether they are further than before.

    The lines of cells that have been finished are merged, whatever ends this process later.
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


def _last_line(path: Path) -> str:
    lines = path.read_text(errors="replace").strip().splitlines()
    return lines[-1] if lines else "nothing was said, as on a full disk"


def _not_over(store: Store, cells: Sequence[Cell]) -> tuple[list[Cell], int]:
    """Those that are to be played, and how many episodes of the others have been."""
    is_over = {cell: store.is_over(cell) for cell in cells}
    over = [cell for cell in cells if is_over[cell]]
    return [cell for cell in cells if not is_over[cell]], store.num_played(over)


def play(store: Store, part: str, num_workers: int, timeout_s: int | None = None) -> None:
    """Play a part of the cells: start workers, and start those anew that were killed.

    Raises:
        RuntimeError: they end before they play, or refuse to; the message says why.
    """
    environments = worker_environments(num_workers, os.environ, num_cores(), visible_gpus(os.environ))
    command = [*PYTHON, "lerobot_bomb.sweep.worker", str(store.folder), part, store.run]
    command += [str(timeout_s)] if timeout_s else []
    log = store.folder / "workers.log"

    def start(environment: dict[str, str], output: IO[bytes]) -> subprocess.Popen:
        return subprocess.Popen(
            command, env=environment, stdin=subprocess.PIPE, stdout=output, stderr=subprocess.STDOUT
        )

    workers: list[subprocess.Popen] = []
    num_ended = 0  # workers that ended by themselves since an episode was played
    with log.open("ab") as output:
        try:
            for has_played in progress(store, store.manifest.part(part)):
                ended = [number for number, worker in enumerate(workers) if worker.poll() is not None]
                if any(workers[number].returncode == REFUSED for number in ended):
                    raise RuntimeError(_last_line(log))
                num_ended = len(ended) + (0 if has_played else num_ended)
                if num_ended > MAX_ENDED * num_workers:
                    raise RuntimeError(f"workers end before they play: {_last_line(log)}; see {log}")
                for number in ended:
                    workers[number] = start(environments[number], output)
                workers += [start(environment, output) for environment in environments[len(workers) :]]
        finally:
            for worker in workers:
                worker.terminate()
            for worker in workers:
                worker.wait()
