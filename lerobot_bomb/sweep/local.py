"""Jobs that worker processes run on this machine."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from typing import IO

from tqdm import tqdm

from lerobot_bomb.sweep.manifest import Job
from lerobot_bomb.sweep.processes import num_cores, visible_gpus, worker_environments
from lerobot_bomb.sweep.store import POLL_S, REFUSED, Store

# -P: no file in the user's folder replaces a module of the same name
PYTHON = (sys.executable, "-P", "-m")
MAX_ENDED = 3
MAX_SHOWN_WARNINGS = 5


def progress(store: Store, jobs: Sequence[Job]) -> Iterator[bool]:
    """Show progress until all jobs are over; yield True if there was any since the last yield.

    Records of finished jobs are merged at once, whatever ends this process later.
    """
    total = sum(job.num_records for job in jobs)
    left, num_before = _not_over(store, jobs)  # what is over is not read again
    has_progressed, num_unmerged = False, len(jobs)
    with tqdm(total=total, initial=num_before + store.num_run(left), unit=" episodes") as bar:
        while left:
            yield has_progressed
            time.sleep(POLL_S)
            left, num_more = _not_over(store, left)
            num_before += num_more
            more = num_before + store.num_run(left) - bar.n
            if has_progressed := more != 0:
                bar.update(more)
            if len(left) != num_unmerged:
                num_unmerged = len(left)
                store.merge()


def _not_over(store: Store, jobs: Sequence[Job]) -> tuple[list[Job], int]:
    """Return the jobs that are not over, and how many episodes of the others have been run."""
    is_over = {job: store.is_over(job) for job in jobs}
    over = [job for job in jobs if is_over[job]]
    return [job for job in jobs if not is_over[job]], store.num_run(over)


class WorkerProcess:
    """A worker, and the job that it runs, which it reports through a pipe."""

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
        self.job = ""  # its key; "": none
        self.since = time.monotonic()

    def look(self) -> str | None:
        """Read which job is run; return how the worker ended, None while it runs."""
        code = self._process.poll()
        self._unread += self._said.read() or b""
        *jobs, self._unread = self._unread.split(b"\n")
        if jobs:
            self.job, self.since = jobs[-1].decode(), time.monotonic()
        return None if code is None else self._end or ended(code)

    @property
    def is_refused(self) -> bool:
        """Return True if the process ended because flags are wrong."""
        return self._process.returncode == REFUSED

    def kill(self, reason: str = "") -> None:
        """Kill the process, because native code heeds nothing else."""
        self._end = reason
        self._process.kill()

    def close(self) -> None:
        """Wait until the process has ended."""
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
    """Worker processes of one command; each is restarted when it has ended.

    Args:
        store: the sweep.
        command: starts a worker.
        environments: environment variables of each worker.
        timeout_s: limit of a job; None: no limit.
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
        self._jobs = {job.key: job for job in store.manifest.jobs}
        self._path = store.folder / "workers.log"
        self._log = self._path.open("ab")
        self._start = self._log.tell()  # what is before is of earlier commands
        self._workers: list[WorkerProcess] = []
        self._lost: dict[str, str] = {}  # job -> how its worker ended, until it is noted
        self._num_idle_ends = 0  # of workers that had begun no job, since an episode was run

    def look(self, has_progressed: bool) -> None:
        """Start missing workers, and kill those whose job takes too long.

        Raises:
            RuntimeError: workers end before they run a job, or refuse to; the message says why.
        """
        self._num_idle_ends = 0 if has_progressed else self._num_idle_ends
        for number, worker in enumerate(self._workers):
            end = worker.look()
            if end is not None:
                self._end(worker, end)
                self._workers[number] = self._started(number)
            elif worker.job and self._timeout_s and time.monotonic() - worker.since > self._timeout_s:
                worker.kill(f"not finished after {self._timeout_s} s (--timeout)")
        self._workers += map(self._started, range(len(self._workers), len(self._environments)))
        self._note_lost()

    def _started(self, number: int) -> WorkerProcess:
        return WorkerProcess(self._command, self._environments[number], self._log)

    def _end(self, worker: WorkerProcess, end: str) -> None:
        worker.close()
        if worker.is_refused:
            raise RuntimeError(self._last_line() or end)
        if worker.job:
            self._log.write(f"\n{worker.job}: {end}\n".encode())
            self._log.flush()
            self._lost[worker.job] = end
            return
        self._num_idle_ends += 1
        if self._num_idle_ends > MAX_ENDED * len(self._environments):
            reason = "; ".join(filter(None, (end, self._last_line())))
            raise RuntimeError(f"workers end before they run: {reason}; see {self._path}")

    def _note_lost(self) -> None:
        """Note how workers ended; while the next one holds the job, try again later."""
        self._lost = {
            job: end for job, end in self._lost.items() if not self._store.lost(self._jobs[job], end)
        }

    def _last_line(self) -> str:
        """Return the last line that this command's workers have logged, '' if none."""
        return next((line.strip() for line in reversed(self._said()) if line.strip()), "")

    def _said(self) -> list[str]:
        """Return the lines that this command's workers have logged."""
        return self._path.read_bytes()[self._start :].decode(errors="replace").split("\n")

    def warnings(self) -> list[str]:
        """Return this package's warnings in workers, each once."""
        found = (re.match(r"WARNING:lerobot_bomb[\w.]*:(.+)", line) for line in self._said())
        return list(dict.fromkeys(match[1] for match in found if match))

    def close(self) -> None:
        """Kill all workers and wait for them."""
        for worker in self._workers:
            worker.kill()
        for worker in self._workers:
            worker.close()
        self._note_lost()
        self._log.close()


def run_part(store: Store, part: str, num_workers: int, timeout_s: int | None = None) -> None:
    """Run a part of the jobs: start workers, and restart those that ended.

    Raises:
        RuntimeError: workers end before they run a job, or refuse to; the message says why.
    """
    jobs = store.manifest.part(part)
    num_workers = min(num_workers, len(jobs))
    environments = worker_environments(num_workers, os.environ, num_cores(), visible_gpus(os.environ))
    command = [*PYTHON, "lerobot_bomb.sweep", str(store.folder), part, store.run]
    workers = Workers(store, command, environments, timeout_s)
    try:
        for has_progressed in progress(store, jobs):
            workers.look(has_progressed)
    finally:
        workers.close()
        for warning in workers.warnings()[:MAX_SHOWN_WARNINGS]:
            print(f"warning: {warning}", file=sys.stderr)
