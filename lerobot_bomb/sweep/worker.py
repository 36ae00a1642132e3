"""Worker that runs the jobs of a sweep that no other worker runs, one by one, in one process."""

import faulthandler
import io
import json
import logging
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import redirect_stderr
from pathlib import Path
from typing import TextIO

from lerobot.envs import EnvConfig

from lerobot_bomb.checkpoints.identity import identity_of
from lerobot_bomb.compat.own.evaluation import KeptPolicy
from lerobot_bomb.environments import env_type
from lerobot_bomb.evaluation.eval_info import EVAL_INFO, results_of
from lerobot_bomb.files import read_json
from lerobot_bomb.flags import flag_value
from lerobot_bomb.sweep.check import check
from lerobot_bomb.sweep.manifest import Job, Manifest
from lerobot_bomb.sweep.store import POLL_S, REFUSED, EpisodeError, Store, missing_seeds


class RefusedError(Exception):
    """Refusal: LeRobot's command ended before its first episode, so no attempt can do better."""


FATAL = (RefusedError, OSError)  # for a job, whichever episode it was


class Worker:
    """Worker process of a sweep.

    Args:
        store: the sweep.
        tell: called with the key of a job that begins, and with '' when it ends.
    """

    def __init__(self, store: Store, tell: Callable[[str], None] = lambda key: None) -> None:
        self._store, self._tell = store, tell
        self._kept = KeptPolicy()

    def run(self, jobs: list[Job]) -> None:
        """Run jobs until each is finished or given up, by this worker or by others."""
        while left := [job for job in jobs if not self._store.is_over(job)]:
            for job in self._store.in_turn(left):
                with self._store.claimed(job) as is_mine:
                    if is_mine and not self._store.is_over(job) and self._store.begin(job):
                        self._tell(job.key)
                        self._attempt(job)
                        self._tell("")
            time.sleep(POLL_S)  # others run the rest; what a killed one leaves is for those that remain

    def _attempt(self, job: Job) -> None:
        try:
            try:
                lines, errors = self._evaluate(job, job), []
            except FATAL:
                raise
            except Exception as error:
                logging.warning("%s: %s; its episodes are run one by one", job.key, describe(error))
                lines, errors = self._one_by_one(job)
            self._store.finish(job, lines, errors)
        except RefusedError as error:
            self._store.give_up(job, str(error))
        except OSError as error:
            self._store.fail(job, describe(error))

    def _one_by_one(self, job: Job) -> tuple[list[str], list[EpisodeError]]:
        lines, errors, record_type = [], [], env_type(job.env_type).record
        for number in range(job.num_episodes):
            episode = job.episode(number)
            try:
                lines += self._evaluate(episode, job)
            except FATAL:
                raise
            except Exception as error:
                again = job if record_type.starts_by_number else episode
                errors.append(EpisodeError(job.key, episode.seed, describe(error), again.command))
        return lines, errors

    def _evaluate(self, job: Job, whole: Job) -> list[str]:
        """Run a job, a part of `whole`, and return its records in the order of their seeds."""
        part = self._store.file(job, "part")
        part.unlink(missing_ok=True)
        check_assets(job)
        output_dir = tempfile.mkdtemp(prefix=".output-", dir=part.parent)
        flags = [*job.flags, f"--output_dir={output_dir}"]
        writes_records = env_type(job.env_type).record.has_results_path
        flags += [f"--env.results_path={part}"] if writes_records else []
        said = LastLine(sys.stderr)
        try:
            with redirect_stderr(said):
                self._kept.evaluate(flags, (whole.policy, whole.seed), job.seed - whole.seed)
            if writes_records:
                lines = part.read_text().splitlines()
            else:
                lines = self._stock_lines(job, whole, Path(output_dir))
        except (Exception, SystemExit) as error:
            if self._kept.has_begun or isinstance(error, OSError):
                raise
            is_told = isinstance(error, SystemExit) and isinstance(error.code, int) and said.line
            raise RefusedError(said.line if is_told else describe(error)) from error
        finally:
            shutil.rmtree(output_dir, ignore_errors=True)
            part.unlink(missing_ok=True)
        by_seed = sorted(lines, key=lambda line: json.loads(line)["spec"]["seed"])
        if missing := missing_seeds(job, by_seed, []):
            raise RuntimeError(f"{job.num_episodes - len(missing)} of {job.num_episodes} episodes ended")
        return by_seed

    def _stock_lines(self, job: Job, whole: Job, output_dir: Path) -> list[str]:
        """Return the records of an environment of LeRobot's own, which lerobot-eval has just run."""
        assert self._kept.policy is not None
        results = results_of(
            read_json(output_dir / EVAL_INFO),
            self._kept.env_config,
            identity_of(self._kept.policy),
            job.seed,
            job.batch_size,
            job.seed - whole.seed,
        )
        return [result.to_json() for result in results]


def check_assets(job: Job) -> None:
    """Raise a RefusedError where an environment would ask a question or download before it starts."""
    env = env_type(job.env_type)
    if not env.check_at:
        return
    tasks = flag_value(job.env, "--env.task") or EnvConfig.get_choice_class(job.env_type).task
    try:
        env.check(str(tasks).split(","))
    except ValueError as error:
        raise RefusedError(str(error)) from error


class LastLine(io.TextIOBase):
    """Passes text on to a stream, and keeps its last line, in which a command that exits says why."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.line = ""

    def write(self, text: str, /) -> int:
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        self.line = lines[-1] if lines else self.line
        return self._stream.write(text)

    def flush(self) -> None:
        self._stream.flush()


def describe(error: BaseException) -> str:
    """Describe an error as 'ValueError: its first line ... its last line'."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    told = " ... ".join(dict.fromkeys([*lines[:1], *lines[-1:]]))
    return f"{type(error).__name__}: {told}" if told else type(error).__name__


def run_worker(folder: str, part: str, run: str, told: str) -> None:
    """Run a part of the sweep in a folder; report the running job to the file descriptor `told`."""
    faulthandler.enable()  # a fault of native code says where it was
    logging.basicConfig(level=logging.WARNING)
    manifest = Manifest.read(Path(folder))
    store = Store(Path(folder), manifest, run)
    left = Manifest(tuple(job for job in manifest.jobs if not store.is_over(job)))
    try:
        check(left, [job for job in manifest.jobs if store.has_begun(job)])
    except (ValueError, SystemExit) as error:
        if isinstance(error, ValueError):
            print(error, file=sys.stderr)
        sys.exit(REFUSED)
    Worker(store, lambda key: _tell(int(told), key)).run(manifest.part(part))


def _tell(told: int, key: str) -> None:
    os.write(told, f"{key}\n".encode())
