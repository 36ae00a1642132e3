"""Store of a sweep's progress: a folder that any number of workers share.

A job is finished when `cells/KEY.jsonl` holds all its episodes. A worker that runs it holds the lock on
`cells/KEY.lock`, which the system releases if the worker is killed. The job is then run again, with three
attempts at most in one run. Stopping a sweep, whose workers may outlive it by moments, is no failed attempt.
"""

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from fcntl import LOCK_EX, LOCK_NB, flock
from pathlib import Path
from uuid import uuid4

from lerobot_bomb.files import append_line, written_whole
from lerobot_bomb.sweep.manifest import Job, Manifest

MAX_ATTEMPTS = 3
REFUSED = 3  # exit code of a worker that runs nothing; the last line of its log says why
POLL_S = 0.5  # between two looks at what other processes have done
UNSEEN_END = "workers ended while they ran it"  # said by the next worker, which did not see how
# the folder and the key keep the name that they have in sweeps of earlier versions
JOBS, RESULTS, ERRORS = "cells", "results.jsonl", "errors.jsonl"


@dataclass(frozen=True)
class EpisodeError:
    """A seed whose episodes, one of each task, have no result, which does not count as a failure."""

    job: str  # its key
    seed: int
    error: str
    command: str  # runs it again

    def to_json(self) -> str:
        """Return its line in a file, where the job is `cell`."""
        values = asdict(self)
        return json.dumps({"cell": values.pop("job"), **values})

    @classmethod
    def from_json(cls, line: str | bytes) -> "EpisodeError":
        """Read a line of a file.

        Raises:
            ValueError, TypeError: the line is no error of an episode.
        """
        return cls(
            **{"job" if name == "cell" else name: value for name, value in dict(json.loads(line)).items()}
        )


def num_lost(manifest: Manifest, errors: Iterable[EpisodeError]) -> int:
    """Count the episodes that have no result because of these errors: those of all tasks of their seeds."""
    num_tasks = {job.key: job.num_tasks for job in manifest.jobs}
    return sum(num_tasks.get(error.job, 0) for error in errors)


def missing_seeds(job: Job, lines: Sequence[str | bytes], errors: Sequence[EpisodeError]) -> list[int]:
    """Return a job's seeds that have neither an error nor as many records as the others, one for each task.

    Raises:
        ValueError: a line is no record.
    """
    try:
        counts = Counter(json.loads(line)["spec"]["seed"] for line in lines)
    except (KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"a line is no episode: {error!r}") from None
    failed = {error.seed for error in errors}
    most = max(counts.values(), default=1)
    return [seed for seed in job.seeds if seed not in failed and counts[seed] < most]


class Store:
    """Progress of a sweep, in its folder.

    Args:
        folder: where `manifest` lies.
        manifest: what is run.
        run: names the command whose workers' attempts count together; None: a new one.
    """

    def __init__(self, folder: Path, manifest: Manifest, run: str | None = None) -> None:
        self.folder, self.manifest, self.run = folder, manifest, run or uuid4().hex
        self._whole: dict[Path, tuple[int, int]] = {}  # files that were read and found whole
        (folder / JOBS).mkdir(parents=True, exist_ok=True)

    def file(self, job: Job, ending: str) -> Path:
        """Return a job's file: finished records (.jsonl) or unfinished (.part), errors, attempts, lock."""
        return self.folder / JOBS / f"{job.key}.{ending}"

    def is_finished(self, job: Job) -> bool:
        """Return True if the job's file of records is there and whole; a crash can cut it off."""
        path = self.file(job, "jsonl")
        try:
            state = path.stat()
        except FileNotFoundError:
            return False
        version = (state.st_mtime_ns, state.st_size)
        if self._whole.get(path) != version and self._is_whole(job):
            self._whole[path] = version
        return self._whole.get(path) == version

    def _is_whole(self, job: Job) -> bool:
        *lines, rest = _read(self.file(job, "jsonl")).split(b"\n")
        try:
            return not rest and not missing_seeds(job, lines, self.errors(job))
        except (ValueError, TypeError):  # of either file
            return False

    def is_untouched(self) -> bool:
        """Return True if no episode has been run, with a record or with an error, and none is running."""
        jobs = self.manifest.jobs
        return not any(map(self.has_begun, jobs)) and all(map(self._is_free, jobs))

    def has_begun(self, job: Job) -> bool:
        """Return True if an episode has been run, with a record or with an error, or is running."""
        return any(self.file(job, ending).is_file() for ending in ("jsonl", "part", "errors"))

    def _is_free(self, job: Job) -> bool:
        with self.claimed(job) as is_mine:
            return is_mine

    def begin(self, job: Job) -> bool:
        """Count an attempt and return True; after `MAX_ATTEMPTS`, give the job up and return False."""
        if self._num_attempts(job) >= MAX_ATTEMPTS:
            self.fail(job, UNSEEN_END)
            return False
        append_line(self.file(job, "attempts"), self.run)
        return True

    def fail(self, job: Job, reason: str) -> None:
        """Give the job up if this was its last attempt."""
        if self._num_attempts(job) >= MAX_ATTEMPTS:
            self.give_up(job, f"{reason}; {MAX_ATTEMPTS} attempts")

    def lost(self, job: Job, reason: str) -> bool:
        """Note why the worker that ran the job ended; return False while another worker holds the job."""
        with self.claimed(job) as is_mine:
            known = _read(self.file(job, "given_up")).decode()
            if is_mine and not self.is_finished(job) and (not known or known.startswith(UNSEEN_END)):
                self.fail(job, reason)
            return is_mine

    def in_turn(self, jobs: Sequence[Job]) -> list[Job]:
        """Return the jobs, sorted so that those of a policy that has killed workers come last."""
        attempts = {job: self._num_attempts(job) for job in jobs}
        of_policy: Counter[tuple[str, ...]] = Counter()
        for job, number in attempts.items():
            of_policy[job.policy] += number
        return sorted(jobs, key=lambda job: (of_policy[job.policy], attempts[job]))

    def _num_attempts(self, job: Job) -> int:
        """Count this run's attempts at the job."""
        return _read(self.file(job, "attempts")).split().count(self.run.encode())

    def give_up(self, job: Job, reason: str) -> None:
        """Give a job up: no worker runs it any more."""
        with written_whole(self.file(job, "given_up")) as (path,):
            path.write_text(reason)

    def is_over(self, job: Job) -> bool:
        """Return True if the job is finished or given up."""
        return self.is_finished(job) or self.file(job, "given_up").is_file()

    def begin_again(self, jobs: Sequence[Job]) -> None:
        """Forget the results of jobs that were given up or had episodes with errors."""
        for job in jobs:
            if any(self.file(job, ending).is_file() for ending in ("given_up", "errors")):
                with self.claimed(job) as is_mine:
                    if is_mine:
                        for ending in ("attempts", "given_up", "errors", "jsonl"):
                            self.file(job, ending).unlink(missing_ok=True)

    @contextmanager
    def claimed(self, job: Job) -> Iterator[bool]:
        """Yield True and keep other workers off the job; yield False if another one runs it."""
        with self.file(job, "lock").open("w") as lock:
            try:
                flock(lock, LOCK_EX | LOCK_NB)
            except BlockingIOError:
                yield False
                return
            yield True

    def finish(self, job: Job, lines: list[str], errors: list[EpisodeError]) -> None:
        """Write a job's records, by seed, and the errors of seeds without one."""
        self.file(job, "errors").unlink(missing_ok=True)  # of an attempt that could not be written
        if errors:
            with written_whole(self.file(job, "errors")) as (path,):
                path.write_text("".join(f"{error.to_json()}\n" for error in errors))
        with written_whole(self.file(job, "jsonl")) as (path,):
            path.write_text("".join(f"{line}\n" for line in lines))
        self.file(job, "part").unlink(missing_ok=True)

    def num_run(self, jobs: Sequence[Job]) -> int:
        """Count episodes that have a record or an error, also in jobs that are running."""
        endings = ("jsonl", "part", "errors")
        paths = [self.file(job, ending) for job in jobs for ending in endings]
        return sum(_read(path).count(b"\n") for path in paths)

    def merge(self) -> None:
        """Write all finished jobs' records in the order of the manifest, and all errors."""
        with (self.folder / JOBS / "merge.lock").open("w") as lock:
            flock(lock, LOCK_EX)  # the last to write has read all jobs that earlier ones had finished
            for name, ending in ((RESULTS, "jsonl"), (ERRORS, "errors")):
                paths = [self.file(job, ending) for job in self.manifest.jobs if self.is_finished(job)]
                with written_whole(self.folder / name) as (path,):
                    path.write_bytes(b"".join(map(_read, paths)))

    def lines(self) -> list[str]:
        """Describe finished and missing episodes, and why some are missing."""
        jobs = self.manifest.jobs
        finished = [job for job in jobs if self.is_finished(job)]
        errors = [error for job in finished for error in self.errors(job)]
        episodes = self.num_run(finished) - len(errors)
        text = [
            f"{self.folder / RESULTS}: {episodes} of {self.manifest.num_records} episodes, "
            f"{len(finished)} of {len(jobs)} jobs"
        ]
        if errors:
            number = num_lost(self.manifest, errors)
            text.append(f"{self.folder / ERRORS}: {number} episodes have no result, an error ended them:")
            causes = Counter(error.error for error in errors)
            text += [f"  {number} x {cause}" for cause, number in causes.most_common()]
        given_up = [job for job in jobs if not self.is_finished(job) and self.is_over(job)]
        for job in given_up:
            why = self.file(job, "given_up").read_text().splitlines()
            text += [f"given up: {job.command}", *(f"  {line}" for line in why)]
        if errors or given_up:
            text.append(f"to run them again: lerobot-bomb sweep {self.folder} --retry")
        if given_up and self.is_untouched():
            text.append("nothing was run, so the folder takes a sweep with other flags, too")
        others = self._of_other_manifests()
        if others:
            text.append(f"not counted, for the manifest has changed: {len(others)} jobs, as {others[0]}")
        return text

    def errors(self, job: Job) -> list[EpisodeError]:
        """Return the errors of a finished job."""
        return read_errors(self.file(job, "errors"))

    def _of_other_manifests(self) -> list[Path]:
        known = {job.key for job in self.manifest.jobs}
        return [path for path in sorted((self.folder / JOBS).glob("*.jsonl")) if path.stem not in known]


def read_errors(path: Path) -> list[EpisodeError]:
    """Read a file of errors; none where there is no file.

    Raises:
        ValueError, TypeError: a line is no error of an episode.
    """
    return [EpisodeError.from_json(line) for line in _read(path).splitlines()]


def _read(path: Path) -> bytes:
    """Read a file; empty where there is none: another process may remove it at any moment."""
    try:
        return path.read_bytes()
    except FileNotFoundError:
        return b""
