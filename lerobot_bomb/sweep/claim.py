"""Claim on a sweep's folder, which belongs to one manifest at a time. The manifest may grow."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from fcntl import LOCK_EX, LOCK_NB, LOCK_SH, flock
from pathlib import Path
from typing import IO

from lerobot_bomb.environments import env_type
from lerobot_bomb.sweep.manifest import NAME, Job, Manifest, largest_divisor
from lerobot_bomb.sweep.store import Store

LOCK = "sweep.lock"  # held by every command that runs the manifest; alone by one that writes it


@contextmanager
def claimed(folder: Path, wanted: Manifest, batch_size: int | None = None) -> Iterator[Store]:
    """Hold a folder for a manifest: the wanted one, or the folder's own, extended by the wanted one.

    Other commands may run the same manifest at the same time; stderr says so.

    Args:
        folder: created if it is missing.
        wanted: the jobs to run.
        batch_size: largest of a job. If it is given, the folder's jobs count as the first episodes of longer
            ones.

    Raises:
        ValueError: the folder has episodes of other jobs, or another command runs other jobs there.
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
                f"another command is running other jobs in {folder} now; wait for its end, or name another "
                "folder"
            )
        if not is_alone:
            print(f"another command runs jobs of {folder} now; both share them", file=sys.stderr)
        yield Store(folder, manifest)


def _is_alone(lock: IO[str]) -> bool:
    try:
        flock(lock, LOCK_EX | LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _grown(folder: Path, there: Manifest | None, wanted: Manifest, batch_size: int | None) -> Manifest:
    """Return the folder's manifest from now on: the wanted one, with the folder's jobs unchanged.

    Raises:
        ValueError: the folder has jobs that are not wanted, and some of its episodes have been run.
    """
    if there is None or there == wanted or Store(folder, there).is_untouched():
        return wanted
    jobs = wanted.jobs
    if batch_size is not None:
        jobs = tuple(part for job in jobs for part in _with_rest(job, there, batch_size))
    others = [job for job in there.jobs if job not in jobs]
    if others:
        raise ValueError(
            f"{folder / NAME} is of another sweep: of its jobs these flags lack {len(others)}, as "
            f"{others[0].command}. Name another folder; or give its flags, with more policies, tasks, "
            f"perturbations or episodes if you like; or resume it by `lerobot-bomb sweep {folder}`"
        )
    return Manifest(jobs)


def _with_rest(job: Job, there: Manifest, batch_size: int) -> list[Job]:
    """Split a job into the folder's jobs from its seed on, and one with the missing seeds.

    Raises:
        ValueError: the latter would start its episodes differently.
    """
    of_same = {each.seed: each for each in there.jobs if (each.policy, each.env) == (job.policy, job.env)}
    parts: list[Job] = []
    seed, end = job.seeds.start, job.seeds.stop
    while seed in of_same:
        parts.append(of_same[seed])
        seed = parts[-1].seeds.stop
    are_alike = all(part.batch_size == largest_divisor(part.num_episodes, batch_size) for part in parts)
    if seed > end or not parts or not are_alike:
        return [job]
    if seed == end:
        return parts
    if env_type(job.env_type).record.starts_by_number:
        raise ValueError(
            f"--episodes={job.num_episodes}: jobs of --env.type={job.env_type} do not grow, because an "
            "episode starts as its number in the job says; run more in another folder"
        )
    return [*parts, Job(job.policy, job.env, seed, end - seed, largest_divisor(end - seed, batch_size))]
