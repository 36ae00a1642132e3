"""``lerobot-bomb sweep``: policies x tasks x conditions, over several processes, going on after a kill."""

import argparse
import os
import subprocess
import sys
import time
from typing import IO

from tqdm import tqdm

from lerobot_bomb.bomb.episode import TEST_SEEDS
from lerobot_bomb.commands.arguments import parse_conditions, path_flag
from lerobot_bomb.evaluation.result_lines import KINDS
from lerobot_bomb.sweep.manifest import NAME, Cell, Manifest, plan
from lerobot_bomb.sweep.store import Store

CONDITIONS = {kind.env_type: kind.condition for kind in KINDS}
POLL_S = 0.5
MAX_BATCH = 10
MAX_ENDED = 3


def add_sweep_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``lerobot-bomb sweep``."""
    parser.usage = (
        "lerobot-bomb sweep FOLDER [--policies=A,B --env.type=bomb ...] (and flags of lerobot-eval)"
    )
    add = parser.add_argument
    add("folder", type=path_flag, metavar="FOLDER", help="new, or of a sweep that is to go on")
    add(
        "--policies",
        type=parse_conditions,
        help="checkpoints and policy types: outputs/act,bomb:NAME,TYPE",
    )
    add("--tasks", type=parse_conditions, default=(), help="values of --env.task: place,object")
    conditions = "none,camera:3,all:1-5; each:1-5 is every axis at every level"
    add("--perturbations", type=parse_conditions, default=(), help=conditions)
    add("--episodes", type=int, default=20, help="of each cell (default: 20)")
    add("--seed", type=int, default=TEST_SEEDS[0], help=f"the first one (default: {TEST_SEEDS[0]})")
    add("--batch_size", type=int, default=MAX_BATCH, help=f"at most (default: {MAX_BATCH})")
    add("--workers", type=int, default=1, help="processes (default: 1)")
    add("--shard", default="0/1", help="this machine's part of the cells: 0/4 is the first of four")
    add("--timeout", type=int, help="seconds that a cell may take (default: no limit)")
    add("--retry", action="store_true", help="play again what was given up or ended in errors")
    add(
        "--dry_run",
        action="store_true",
        help="write the manifest and print its commands only",
    )
    add("rest", nargs="*", metavar="FLAG", help="flags of lerobot-eval for every cell: --env.image_size=64")


def run_sweep(args: argparse.Namespace) -> int:
    """Play what is missing; exit code 1 where something still is."""
    manifest = _manifest(args)
    store = Store(args.folder, manifest)
    cells = _shard(args.shard, manifest)
    if args.dry_run:
        print(*(cell.command for cell in cells), sep="\n")
        return 0
    if args.retry:
        store.begin_again()
    store.forget_attempts()
    try:
        _play(args, store, cells)
    except KeyboardInterrupt:
        print(f"interrupted; to go on: lerobot-bomb sweep {args.folder}")
    store.merge()
    print(*store.lines(), sep="\n")
    is_whole = all(store.is_finished(cell) and not store.errors(cell) for cell in cells)
    return 0 if is_whole else 1


def _manifest(args: argparse.Namespace) -> Manifest:
    """The folder's, or a new one."""
    exists = (args.folder / NAME).is_file()
    if args.policies is None:
        if not exists:
            raise ValueError(
                f"{args.folder} holds no {NAME}: begin a sweep with --policies=... --env.type=..."
            )
        if args.rest or args.tasks or args.perturbations:
            raise ValueError(f"{args.folder / NAME} says what is played; drop {(*args.rest, '--tasks')[0]}")
        return Manifest.read(args.folder)
    for name, lowest in (("episodes", 1), ("batch_size", 1), ("seed", 0), ("workers", 1)):
        if getattr(args, name) < lowest:
            raise ValueError(f"--{name}={getattr(args, name)} must be at least {lowest}")
    conditions = _expanded(args.perturbations, args.rest)
    manifest = plan(
        args.policies, args.tasks, conditions, args.seed, args.episodes, args.batch_size, args.rest
    )
    if exists and Manifest.read(args.folder) != manifest:
        raise ValueError(
            f"{args.folder / NAME} is of another sweep; name another folder, or go on with that one by "
            f"`lerobot-bomb sweep {args.folder}`"
        )
    if not exists:
        manifest.write(args.folder)
    return manifest


def _expanded(perturbations: tuple[str, ...], flags: list[str]) -> list[str]:
    """The conditions, checked for the environment where it has any."""
    env_type = next((flag.partition("=")[2] for flag in flags if flag.startswith("--env.type=")), None)
    if env_type is None:
        raise ValueError(f"--env.type is missing: {', '.join(CONDITIONS)}")
    if env_type not in CONDITIONS:
        raise ValueError(
            f"--env.type={env_type} writes no lines of results, which a sweep is made of; "
            f"those that do: {', '.join(CONDITIONS)}"
        )
    of_env = CONDITIONS[env_type]
    return [str(of_env.parse(text)) for text in of_env.expand(perturbations)]


def _shard(text: str, manifest: Manifest) -> list[Cell]:
    try:
        return manifest.part(text)
    except ValueError as error:
        raise ValueError(f"--shard: {error}") from None


def _play(args: argparse.Namespace, store: Store, cells: list[Cell]) -> None:
    """Start workers, show how far they are, and start those anew that were killed."""
    threads = max(1, (os.cpu_count() or 1) // args.workers)
    environment = {"OMP_NUM_THREADS": str(threads)} | os.environ
    # -P: nothing in the folder that the user is in stands for a module of the same name
    command = [sys.executable, "-P", "-m", "lerobot_bomb.sweep.worker", str(args.folder), args.shard]
    command += [str(args.timeout)] if args.timeout else []
    log = args.folder / "workers.log"
    total = sum(cell.num_episodes for cell in cells)

    def start(output: IO[bytes]) -> subprocess.Popen:
        return subprocess.Popen(
            command, env=environment, stdin=subprocess.PIPE, stdout=output, stderr=subprocess.STDOUT
        )

    workers: list[subprocess.Popen] = []
    num_ended = 0  # workers that ended by themselves since an episode was played
    with (
        log.open("ab") as output,
        tqdm(total=total, initial=store.num_played(cells), unit=" episodes") as bar,
    ):
        try:
            while not all(store.is_over(cell) for cell in cells):
                running = [worker for worker in workers if worker.poll() is None]
                num_ended += len(workers) - len(running)
                if num_ended > MAX_ENDED * args.workers:
                    raise RuntimeError(f"workers end before they play; {log} says why")
                workers = running + [start(output) for _ in range(args.workers - len(running))]
                time.sleep(POLL_S)
                if (played := store.num_played(cells)) != bar.n:
                    bar.update(played - bar.n)
                    num_ended = 0
        finally:
            for worker in workers:
                worker.terminate()
            for worker in workers:
                worker.wait()
