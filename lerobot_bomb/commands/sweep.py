"""``lerobot-bomb sweep``: policies x tasks x conditions, on processes or a cluster; resumes after a kill."""

import argparse
import shlex
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches

from lerobot_bomb.bomb.episode import MAX_SEED, TEST_SEEDS
from lerobot_bomb.checkpoints.registered import registered_types
from lerobot_bomb.commands.arguments import add_env_flag, check_at_least, parse_conditions, path_flag
from lerobot_bomb.commands.cluster_jobs import (
    SUBMITIT,
    add_job_arguments,
    check_num_jobs,
    shard_of,
    submitted,
    write_job_array,
)
from lerobot_bomb.commands.next_steps import print_next
from lerobot_bomb.commands.table import PROGRAM
from lerobot_bomb.environments import ENVIRONMENTS, env_type
from lerobot_bomb.flags import flag_value, one_of
from lerobot_bomb.results.record import Record
from lerobot_bomb.sweep.claim import claimed
from lerobot_bomb.sweep.local import PYTHON, progress, run_part
from lerobot_bomb.sweep.manifest import NAME, Job, Manifest, plan, policy_flag
from lerobot_bomb.sweep.store import RESULTS, Store
from lerobot_bomb.tables import print_lines

SCRIPT = "sweep.sbatch"
ALL = "0/1"  # the only part


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.usage = (
        "lerobot-bomb sweep FOLDER [--policies=A,B --env.type=bomb ...] (and flags of lerobot-eval)"
    )
    add = parser.add_argument
    add("folder", type=path_flag, metavar="FOLDER", help="new folder, or one of a sweep to resume")
    add(
        "--policies",
        type=parse_conditions,
        help="checkpoints and policy types: outputs/act,bomb:NAME,TYPE",
    )
    tasks = "values of --env.task: place,object"
    add("--env.task", "--task", "--tasks", dest="tasks", type=parse_conditions, default=(), help=tasks)
    conditions = "none,camera:3,all:1-5; each:1-5 is every axis at every level"
    add_env_flag(parser, "perturbations", type=parse_conditions, default=(), help=conditions)
    add("--episodes", type=int, default=20, help="of each task and condition (default: 20)")
    add("--seed", type=int, default=TEST_SEEDS[0], help=f"the first one (default: {TEST_SEEDS[0]})")
    add("--batch_size", type=int, help=f"at most (default: {Record.sweep_batch}; LIBERO: 1)")
    add("--workers", type=int, default=1, help="processes, each on a GPU in turn (default: 1)")
    add_job_arguments(parser, "jobs", f"FOLDER/{SCRIPT}")
    add("--timeout", type=int, help="seconds that a job may take (default: no limit)")
    add("--retry", action="store_true", help="run again what was given up or ended in errors")
    add(
        "--dry_run",
        action="store_true",
        help="write the manifest and print its commands only",
    )
    add("rest", nargs="*", metavar="FLAG", help="flags of lerobot-eval for every job: --env.image_size=64")


def run(args: argparse.Namespace) -> int:
    """Run all missing episodes; exit code 1 if some are still missing."""
    _check_numbers(args)
    manifest = _manifest(args)
    if not (args.dry_run or args.slurm or args.submitit):  # another machine may have what this one lacks
        for name, tasks in {(job.env_type, flag_value(job.env, "--env.task")) for job in manifest.jobs}:
            env_type(name).check(tasks.split(",") if tasks else ())
    with claimed(args.folder, manifest, args.batch_size) as store:
        jobs = _jobs(args, store.manifest)
        if args.dry_run:
            print(*(job.command for job in jobs), sep="\n")
            return 0
        if args.retry:  # now, not when a cluster's job starts: a late one would delete what another finished
            store.begin_again(jobs)
        if args.slurm is not None:
            write_job_array(_part_command(args), args.slurm, args.folder / SCRIPT)
            return 0
        return _run_jobs(args, store, jobs)


def _run_jobs(args: argparse.Namespace, store: Store, jobs: list[Job]) -> int:
    try:
        with interrupted_by_sigterm():
            if args.submitit is None:
                run_part(store, args.shard or ALL, args.workers, args.timeout)
            else:
                _run_on_cluster(args, store)
    except KeyboardInterrupt:
        store.merge()
        to_resume = (
            f"to resume: lerobot-bomb sweep {args.folder} (a job that is not finished: from its start)"
        )
        print_lines(*store.lines(), to_resume)
        raise
    store.merge()
    print_lines(*store.lines())
    if any(map(store.is_finished, jobs)):
        path = str(store.folder / RESULTS)
        steps = {"results": "rates, changes and failures"}
        if len({job.policy for job in store.manifest.jobs}) == 2:
            steps["compare"] = "which policy is better"
        print_next({shlex.join([PROGRAM, name, path]): purpose for name, purpose in steps.items()})
    is_whole = all(store.is_finished(job) and not store.errors(job) for job in jobs)
    return 0 if is_whole else 1


@contextmanager
def interrupted_by_sigterm() -> Iterator[None]:
    """Let a cluster's SIGTERM end this process as Ctrl-C does: finished jobs are merged and printed."""
    usual = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, usual)


def _check_numbers(args: argparse.Namespace) -> None:
    check_at_least(args, episodes=1, seed=0, workers=1)
    shard_of(args)
    check_at_least(args, **{name: 1 for name in ("batch_size", "timeout") if getattr(args, name) is not None})
    if args.seed + args.episodes - 1 > MAX_SEED:
        raise ValueError(f"--seed={args.seed} and --episodes={args.episodes}: the last seed is {MAX_SEED}")


def _jobs(args: argparse.Namespace, manifest: Manifest) -> list[Job]:
    """Return the manifest's jobs that this command runs."""
    try:
        jobs = manifest.part(args.shard or ALL)
    except ValueError as error:
        raise ValueError(f"--shard: {error}") from None
    check_num_jobs(args, len(jobs), "jobs")
    return jobs


def _manifest(args: argparse.Namespace) -> Manifest:
    """Return the manifest of the flags or, without --policies, that of the folder."""
    if args.policies is None:
        if not (args.folder / NAME).is_file():
            raise ValueError(
                f"{args.folder} holds no {NAME}: begin a sweep with --policies=... --env.type=..."
            )
        if args.rest or args.tasks or args.perturbations:
            raise ValueError(f"{args.folder / NAME} says what is run; drop {(*args.rest, '--env.task')[0]}")
        return Manifest.read(args.folder)
    if not args.policies:
        raise ValueError("--policies names none")
    record_type = _record_type(args.rest)
    _check_types(args.policies, args.rest)
    for task in args.tasks if record_type.tasks else ():
        one_of("--env.task", task, record_type.tasks)
    conditions = _expanded(args.perturbations, record_type)
    args.batch_size = 1 if record_type.starts_by_number else args.batch_size or record_type.sweep_batch
    return plan(args.policies, args.tasks, conditions, args.seed, args.episodes, args.batch_size, args.rest)


def _record_type(flags: list[str]) -> type[Record]:
    """Return the type of the records of the environment that the flags name."""
    name = flag_value(flags, "--env.type")
    if name is None:
        raise ValueError(f"--env.type is missing: {', '.join(ENVIRONMENTS)}, or another one of LeRobot's")
    if name not in ENVIRONMENTS:
        _check_known(f"--env.type={name} is no env type", name, _registered("envs", flags))
    return env_type(name).record


def _check_types(policies: Sequence[str], flags: Sequence[str]) -> None:
    """Raise a ValueError if a policy is no checkpoint and no registered type, as far as source shows."""
    types = [policy for policy in policies if policy_flag(policy).startswith("--policy.type=")]
    known = _registered("policies", flags) if types else None
    for name in types:
        _check_known(f"--policies: {name} is no folder and no policy type", name, known)


def _registered(kind: str, flags: Sequence[str]) -> set[str] | None:
    """Return the registered types; None if a package that is imported later may add some."""
    return None if any("discover_packages_path" in flag for flag in flags) else registered_types(kind)


def _check_known(refusal: str, name: str, known: set[str] | None) -> None:
    if known is not None and name not in known:
        near = "".join(f"; nearest: {each}" for each in get_close_matches(name, known, n=1))
        raise ValueError(f"{refusal}{near}")


def _expanded(perturbations: tuple[str, ...], record_type: type[Record]) -> Sequence[str]:
    """Expand the conditions, and check them for the environment."""
    name = record_type.env_type
    if perturbations and not record_type.condition.axes:
        others = f"; --env.type=bomb_{name} has" if f"bomb_{name}" in ENVIRONMENTS else ""
        raise ValueError(f"--perturbations={','.join(perturbations)}: --env.type={name} has none{others}")
    return record_type.condition.expand(perturbations)


def _part_command(args: argparse.Namespace) -> list[str]:
    """Return the command that runs the folder's jobs; with --shard it runs a part."""
    command = [*PYTHON, "lerobot_bomb.commands.main", "sweep", str(args.folder.absolute())]
    command += [f"--workers={args.workers}"]
    return command + ([f"--timeout={args.timeout}"] if args.timeout else [])


def _run_on_cluster(args: argparse.Namespace, store: Store) -> None:
    """Submit a cluster job for every part that is not over, and wait for them; Ctrl-C ends them."""
    jobs = list(store.manifest.jobs)
    parts = [f"{number}/{args.submitit}" for number in range(args.submitit)]
    left = [part for part in parts if not all(map(store.is_over, store.manifest.part(part)))]
    commands = [[*_part_command(args), f"--shard={part}"] for part in left]
    with submitted(commands, args, args.folder) as submitted_jobs:
        for _ in progress(store, jobs):
            if all(job.done() for job in submitted_jobs):
                break
    if not all(store.is_over(job) for job in jobs):
        print(f"cluster jobs ended before everything was run; {args.folder / SUBMITIT} says why")
