"""Episodes an hour of ``lerobot-bomb sweep`` against stock ``lerobot-eval`` on the same jobs, in one run.

The peer runs the manifest's own commands one after the other. A second row runs all conditions in one
command, with LeRobot's default of one process per environment. All rows but that one must give the same
records, or the benchmark stops. Times include starting Python and loading the policy.

    python benchmarks/sweep_speed.py --json sweep_speed.json
"""

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from machine import make_parser, parse_on_idle_machine, positive, print_rows, write_figures

from lerobot_bomb.results.groups import read_results
from lerobot_bomb.results.record import Record
from lerobot_bomb.sweep.manifest import Manifest, plan

FLAGS = ("--env.type=bomb", "--env.image_size=64", "--policy.device=cpu")
SEED = 1000
EACH, TOGETHER = "lerobot-eval, a command a job", "lerobot-eval, all conditions at once"
ONE, TWO = "sweep, 1 worker", "sweep, 2 workers"
TARGETS = {ONE: (EACH, 1.5), TWO: (ONE, 1.7)}


def main() -> None:
    """Run the same jobs in four ways, print episodes an hour and ratios."""
    parser = make_parser(__doc__)
    add = parser.add_argument
    add("--policy", default="bomb:vla0_smol", help="checkpoint or type (default: bomb:vla0_smol)")
    add("--conditions", default="none,camera:3,light:3,table:3,start:3,language:3", help="joined by commas")
    add("--episodes", type=positive, default=20, help="of each job (default: 20)")
    add("--batch_size", type=positive, default=10, help="default: 10")
    args = parse_on_idle_machine(parser)
    conditions = args.conditions.split(",")
    manifest = plan([args.policy], ["place"], conditions, SEED, args.episodes, args.batch_size, FLAGS)

    ways: dict[str, Callable[[Path], Path]] = {
        EACH: lambda folder: run_each(manifest, folder),
        TOGETHER: lambda folder: run_together(manifest, conditions, folder),
        ONE: lambda folder: sweep(manifest, folder, 1),
        TWO: lambda folder: sweep(manifest, folder, 2),
    }
    hourly, records = {}, {}
    for name, run_way in ways.items():
        with tempfile.TemporaryDirectory() as folder:
            started = time.perf_counter()
            results = run_way(Path(folder))
            hourly[name] = 3600 * manifest.num_records / (time.perf_counter() - started)
            records[name] = comparable(read_results(results))
        if name != TOGETHER and records[name] != records[EACH]:  # its batches are of another kind
            raise SystemExit(f"{name} gives other records than {EACH}")

    title = f"{args.policy}, {len(conditions)} conditions of {args.episodes} episodes"
    rows = {
        name: {"episodes_an_hour": value, "ratio": value / hourly[EACH]} for name, value in hourly.items()
    }
    print_rows(title, rows)
    for name, (peer, target) in TARGETS.items():
        ratio = hourly[name] / hourly[peer]
        print(f"{name}: {ratio:.2f} times {peer} (target: {target})")
    write_figures(args.json, {"episodes_an_hour": hourly})


def run_each(manifest: Manifest, folder: Path) -> Path:
    """Run the command of every job; return the results file."""
    results = folder / "results.jsonl"
    for number, job in enumerate(manifest.jobs):
        run(
            "lerobot-eval",
            [*job.flags, f"--env.results_path={results}", f"--output_dir={folder / str(number)}"],
        )
    return results


def run_together(manifest: Manifest, conditions: Sequence[str], folder: Path) -> Path:
    """Run one command with all conditions; return the results file."""
    results, job = folder / "results.jsonl", manifest.jobs[0]
    replaced = ("--env.perturbations=", "--eval.use_async_envs=")
    flags = [flag for flag in job.flags if not flag.startswith(replaced)]
    flags += [f"--env.perturbations={json.dumps(conditions)}", f"--env.results_path={results}"]
    run("lerobot-eval", [*flags, f"--output_dir={folder / 'eval'}"])
    return results


def sweep(manifest: Manifest, folder: Path, num_workers: int) -> Path:
    """Sweep the manifest; return the results file."""
    manifest.write(folder)
    run("lerobot-bomb", ["sweep", str(folder), f"--workers={num_workers}"])
    return folder / "results.jsonl"


def run(command: str, flags: Sequence[str]) -> None:
    """Run a command of this environment; exit with the end of its error output if it fails."""
    path = Path(sys.executable).with_name(command)
    done = subprocess.run([path, *flags], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{command} {' '.join(flags)}:\n{done.stderr[-2000:]}")


def comparable(rows: list[Record]) -> list[Record]:
    """Return the records in one order, without timings and the evaluation's identity."""
    same = [replace(each, inference=None, evaluation=None) for each in rows]
    return sorted(same, key=lambda record: repr(record.spec))


if __name__ == "__main__":
    main()
