"""Manifest of a sweep: its jobs, each of them one evaluation by LeRobot's command."""

import hashlib
import json
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from lerobot_bomb.checkpoints.names import CONFIG, is_hub_id
from lerobot_bomb.checkpoints.shipped import checkpoint_path
from lerobot_bomb.environments import env_type
from lerobot_bomb.files import read_json, written_whole
from lerobot_bomb.flags import flag_value

VERSION = 1
NAME = "manifest.json"
RESERVED = ("--output_dir", "--env.results_path", "--env.perturbations", "--env.task", "--seed")
RESERVED_PREFIXES = ("--eval.", "--policy.path", "--policy.type")


@dataclass(frozen=True)
class Job:
    """One policy under one condition on consecutive seeds."""

    policy: tuple[str, ...]  # flags of lerobot-eval
    env: tuple[str, ...]  # the same
    seed: int  # the first one
    num_episodes: int  # of each of its tasks
    batch_size: int

    @property
    def flags(self) -> list[str]:
        """Flags of lerobot-eval; with `--env.results_path` they give the records of this job."""
        own = (f"--seed={self.seed}", f"--eval.n_episodes={self.num_episodes}")
        batch = (f"--eval.batch_size={self.batch_size}", "--eval.use_async_envs=false")
        return [*self.policy, *self.env, *own, *batch]

    @property
    def command(self) -> str:
        """Command that a user would type."""
        return shlex.join(["lerobot-eval", *self.flags])

    @property
    def key(self) -> str:
        """Flags in a form for file names; equal for equal jobs only."""
        words = "-".join(flag.partition("=")[2] for flag in (*self.policy[:1], *self.env))
        readable = re.sub(r"[^a-z0-9_.]+", "-", words.lower()).strip("-")
        digest = hashlib.sha256(json.dumps(self.flags).encode()).hexdigest()
        return f"{readable[-60:].strip('-')}-{self.seed}-{digest[:8]}"

    @property
    def seeds(self) -> range:
        """Seeds of its episodes."""
        return range(self.seed, self.seed + self.num_episodes)

    @property
    def env_type(self) -> str:
        """Type of the environment, as LeRobot names it; '' where the flags name none."""
        return flag_value(self.env, "--env.type") or ""

    @property
    def num_tasks(self) -> int:
        """Tasks, each with an episode of every seed, as far as the flags tell how many there are."""
        return env_type(self.env_type).record.num_tasks(self.env)

    @property
    def num_records(self) -> int:
        """Episodes of all its tasks together."""
        return self.num_episodes * self.num_tasks

    def episode(self, number: int) -> "Job":
        """Return the job of one of its episodes."""
        return Job(self.policy, self.env, self.seed + number, 1, 1)


@dataclass(frozen=True)
class Manifest:
    """Jobs of a sweep, in the order of its records, each once."""

    jobs: tuple[Job, ...]

    def __post_init__(self) -> None:
        if len({job.key for job in self.jobs}) < len(self.jobs):
            raise ValueError("a job is there twice")

    @property
    def num_records(self) -> int:
        return sum(job.num_records for job in self.jobs)

    def part(self, text: str) -> list[Job]:
        """Return every n-th job: for '0/4' the first, the fifth, ...

        Raises:
            ValueError: the text is malformed, or there are too few jobs for this part.
        """
        first, number = parse_part(text)
        if first >= len(self.jobs):
            raise ValueError(f"{text} has no job: there are {len(self.jobs)}, so take at most as many parts")
        return list(self.jobs[first::number])

    def write(self, folder: Path) -> None:
        """Write the manifest as `NAME` to a folder, which is created."""
        jobs = [vars(job) | {"command": job.command} for job in self.jobs]
        with written_whole(folder / NAME) as (path,):
            path.write_text(json.dumps({"version": VERSION, "cells": jobs}, indent=1) + "\n")

    @classmethod
    def read(cls, folder: Path) -> "Manifest":
        """Read the manifest in a folder.

        Raises:
            FileNotFoundError: there is no manifest.
            ValueError: the manifest is damaged, or of another version of this package.
        """
        path = folder / NAME
        values = read_json(path)
        if values.get("version") != VERSION:
            raise ValueError(f"{path}: version {values.get('version')!r}; this package reads {VERSION}")
        try:
            return cls(tuple(_job(dict(job)) for job in values["cells"]))
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{path}: a job is damaged: {error}") from None


def _job(values: dict[str, Any]) -> Job:
    job = Job(
        policy=tuple(map(str, values["policy"])),
        env=tuple(map(str, values["env"])),
        seed=_at_least(0, values, "seed"),
        num_episodes=_at_least(1, values, "num_episodes"),
        batch_size=_at_least(1, values, "batch_size"),
    )
    if values.get("command", job.command) != job.command:
        raise ValueError(f"its command is not that of its flags, {job.command}; change both, or drop it")
    return job


def _at_least(lowest: int, values: dict[str, Any], name: str) -> int:
    if not isinstance(values[name], int) or values[name] < lowest:
        raise ValueError(f"{name}={values[name]!r} must be a whole number from {lowest} on")
    return values[name]


def parse_part(text: str) -> tuple[int, int]:
    """Parse '0/4' as (0, 4).

    Raises:
        ValueError: the text is malformed, or names no such part.
    """
    first, _, number = text.partition("/")
    if not (first.isdecimal() and number.isdecimal() and int(first) < int(number)):
        raise ValueError(f"{text} must be PART/PARTS, the parts counted from 0: 0/4 to 3/4")
    return int(first), int(number)


def check_flags(flags: Sequence[str]) -> None:
    """Raise a ValueError if a flag of lerobot-eval is one that each job sets itself."""
    for flag in flags:
        name = flag.partition("=")[0]
        if name in RESERVED or name.startswith(RESERVED_PREFIXES):
            raise ValueError(f"{flag}: {name} is set for every job; see --help")


def plan(
    policies: Sequence[str],
    tasks: Sequence[str],
    conditions: Sequence[str],
    seed: int,
    num_episodes: int,
    batch_size: int,
    flags: Sequence[str],
) -> Manifest:
    """Plan every policy on every task under every condition; duplicates are run once.

    Args:
        policies: checkpoints, or policy types.
        tasks: values of `--env.task`; none: LeRobot's default.
        conditions: one job each; none: an environment without perturbations.
        seed: the first one of each job.
        num_episodes: of each job.
        batch_size: of each job, at most.
        flags: of lerobot-eval, for all.

    Raises:
        ValueError: a flag is one that the plan sets.
    """
    check_flags(flags)
    of_policy = [flag for flag in flags if flag.startswith("--policy.")]
    of_env = [flag for flag in flags if not flag.startswith("--policy.")]
    jobs = [
        Job(
            policy=(policy_flag(policy), *of_policy),
            env=(*of_env, *([f"--env.task={task}"] if task else []), *_condition_flags(condition)),
            seed=seed,
            num_episodes=num_episodes,
            batch_size=largest_divisor(num_episodes, batch_size),
        )
        for policy, task, condition in product(policies, tasks or [""], conditions or [""])
    ]
    return Manifest(tuple(dict.fromkeys(jobs)))


def _condition_flags(condition: str) -> list[str]:
    return [f'--env.perturbations=["{condition}"]'] if condition else []


def policy_flag(policy: str) -> str:
    """Return '--policy.path=...' for bomb:NAME, text with a slash or a checkpoint, else '--policy.type=...'.

    Raises:
        ValueError: ``policy`` can be neither a checkpoint, here or on the Hub, nor a type.
    """
    path = checkpoint_path(policy)
    is_here = Path(policy).is_file() or (Path(policy) / CONFIG).is_file()
    is_path = is_here or "/" in policy or path != policy
    if is_path and not Path(path).is_dir() and not is_hub_id(policy):
        raise ValueError(
            f"--policies: {policy} is no folder; name a checkpoint's, bomb:NAME, USER/NAME or a type"
        )
    if is_path and Path(path).is_dir() and not (Path(path) / CONFIG).is_file():
        raise ValueError(
            f"--policies: {policy} holds no {CONFIG}; give the folder that lerobot-train names "
            "pretrained_model"
        )
    if not is_path and not policy.isidentifier():
        raise ValueError(f"--policies: {policy!r} is no policy type; name one, or a checkpoint's folder")
    return f"--policy.{'path' if is_path else 'type'}={policy}"


def largest_divisor(number: int, most: int) -> int:
    """Return the largest divisor up to `most`: LeRobot fills the last batch, so no extra episode is run."""
    return max(size for size in range(1, min(number, most) + 1) if number % size == 0)
