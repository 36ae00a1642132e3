"""Flags that split a command into cluster jobs, shared by several commands."""

import argparse
import json
import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_bomb.sweep.cluster import sbatch_script, submit
from lerobot_bomb.sweep.manifest import parse_part

if TYPE_CHECKING:
    from submitit import Job

SUBMITIT = "submitit"  # folder of its jobs' output
SUBMITIT_FLAGS = (SUBMITIT, "submitit_cluster", "submitit_parameters")


def add_job_arguments(parser: argparse.ArgumentParser, parts_of: str, script: str) -> Any:
    """Declare the flags of parts and of jobs; return the group of flags that exclude one another."""
    where = parser.add_mutually_exclusive_group()
    add = where.add_argument
    add("--shard", metavar="I/N", help=f"do part I of N of the {parts_of} only: 0/4 is the first of four")
    add("--slurm", type=int, metavar="N", help=f"write {script}, a job array of N parts, only")
    add("--submitit", type=int, metavar="N", help="submit N parts as jobs through submitit; wait for them")
    add = parser.add_argument
    add("--submitit_cluster", help="local or slurm (default: slurm where there is srun, else local)")
    parameters = 'of its AutoExecutor, as {"gpus_per_node": 1, "slurm_partition": "gpu"}'
    add("--submitit_parameters", type=_json_object, default={}, metavar="JSON", help=parameters)
    return where


def _json_object(text: str) -> dict[str, Any]:
    try:
        values = json.loads(text)
    except ValueError:
        values = None
    if not isinstance(values, dict):
        raise argparse.ArgumentTypeError(f"{text!r} must be a JSON object")
    return values


def shard_of(args: argparse.Namespace) -> tuple[int, int] | None:
    """Return (0, 4) for --shard=0/4; None without the flag.

    Raises:
        ValueError: the value is no part, or a flag of submitit's stands without --submitit.
    """
    if args.submitit is None and (args.submitit_cluster or args.submitit_parameters):
        raise ValueError("--submitit_cluster and --submitit_parameters need --submitit=N")
    try:
        return None if args.shard is None else parse_part(args.shard)
    except ValueError as error:
        raise ValueError(f"--shard: {error}") from None


def check_num_jobs(args: argparse.Namespace, most: int, parts: str) -> None:
    """Raise a ValueError if more jobs are wanted than there are parts."""
    for name in ("slurm", SUBMITIT):
        number = getattr(args, name)
        if number is not None and not 1 <= number <= most:
            raise ValueError(f"--{name}={number} must be from 1 to the number of {parts}, {most}")


def write_job_array(command: Sequence[str], num_jobs: int, script: Path) -> None:
    """Write a SLURM array script whose jobs run the command's parts, and print how to submit it."""
    script.parent.mkdir(parents=True, exist_ok=True)
    script.write_text(sbatch_script(command, num_jobs, Path.cwd()))
    print(shlex.join(["sbatch", str(script)]))


@contextmanager
def submitted(
    commands: Sequence[Sequence[str]], args: argparse.Namespace, folder: Path
) -> "Iterator[list[Job[int]]]":
    """Submit commands as jobs of submitit, and wait for them at the end; Ctrl-C cancels them."""
    logs = folder / SUBMITIT
    jobs = submit(commands, logs, args.submitit_cluster, args.submitit_parameters) if commands else []
    try:
        yield jobs
        for job in jobs:
            job.wait()
    except KeyboardInterrupt:
        for job in jobs:
            job.cancel(check=False)
        raise
