r"""Success in each suite, and how far from the destination policies read it, over CPU minutes of training.

Evaluates the checkpoints of one or more trainings by `lerobot-train`, each of which began where the one
before ended, and draws two pictures: successes per suite, and the error of the destination that is read from
static scenes that no training has seen, one recording per kind of task (of `vla0_smol`; other types report no
such error). What is finished is not done again.

    OMP_NUM_THREADS=1 python benchmarks/suite_curves.py TRAINING... --s_per_step=1.2 --output_dir=curves \
        --scenes relations=FOLDER ... --plot=curves.png
"""

import json
from collections.abc import Mapping
from pathlib import Path
from statistics import mean

from learn import REPO_ID, checkpoints, evaluate
from learning_curve import set_up, set_up_rates
from learning_tasks import Task
from machine import make_parser, parse_on_idle_machine, positive, write_figures
from matplotlib.figure import Figure

from lerobot_bomb.commands.run import run_command

FIRST_SEED = 50_000  # on which recipes are chosen
SUITES = "place", "object", "spatial", "goal"
READ = "place_l1_m"
COLORS = "#1450a0", "#288c28", "#c83c3c", "#b07d10", "#7d3cb4", "#444444"


def main() -> None:
    """Evaluate every checkpoint, print and draw both curves."""
    parser = make_parser(__doc__)
    parser.add_argument("trainings", type=Path, nargs="+", help="output folders of lerobot-train, in order")
    parser.add_argument("--s_per_step", type=float, required=True, help="CPU seconds of a training step")
    parser.add_argument("--scenes", nargs="+", default=[], help="NAME=FOLDER of static scenes, for vla0_smol")
    parser.add_argument("--episodes", type=positive, default=20, help="of a suite, each (default: 20)")
    parser.add_argument("--output_dir", type=Path, required=True, help="folder to keep, or to resume in")
    parser.add_argument("--plot", type=Path, required=True, help="write the curves to this PNG")
    args = parse_on_idle_machine(parser)
    args.output_dir.mkdir(parents=True, exist_ok=True)
    rates: dict[str, dict[float, float]] = {suite: {} for suite in SUITES}
    errors_mm: dict[str, dict[float, float]] = {text.partition("=")[0]: {} for text in args.scenes}
    for minutes, checkpoint in checkpoints_over_minutes(args.trainings, args.s_per_step).items():
        folder = args.output_dir / f"{minutes:06.1f}_minutes"
        for suite in SUITES:
            task = Task((), episodes=args.episodes, trainings={}, suite=suite)
            rows = evaluate(task, checkpoint, folder / suite, FIRST_SEED, args.episodes)
            rates[suite][minutes] = mean(row.is_success for row in rows)
        for text in args.scenes:
            name, _, scenes = text.partition("=")
            errors_mm[name][minutes] = read_error_mm(checkpoint, Path(scenes), folder / f"{name}.json")
    draw(rates, errors_mm, args.episodes, args.plot)
    write_figures(args.json, {"success": rates, "error_mm": errors_mm, "episodes": args.episodes})


def checkpoints_over_minutes(trainings: list[Path], s_per_step: float) -> dict[float, Path]:
    """Return {CPU minutes since the first training began: checkpoint}."""
    found, steps_before = {}, 0
    for training in trainings:
        of_training = checkpoints(training)
        for step, checkpoint in of_training.items():
            found[(steps_before + step) * s_per_step / 60] = checkpoint
        steps_before += max(of_training)
    return found


def read_error_mm(checkpoint: Path, scenes: Path, figures: Path) -> float:
    """Return the mean distance between the destination that is read from scenes and the true one."""
    if not figures.exists():
        run_command(
            "lerobot-bomb",
            "checkpoint",
            "offline-metrics",
            f"--policy.path={checkpoint}",
            f"--dataset.repo_id={REPO_ID}",
            f"--dataset.root={scenes}",
            "--max_frames=300",
            f"--json={figures}",
        )
    losses = json.loads(figures.read_text())["columns"]["validation"]["losses"]
    return 1000 * losses[READ]["mean"]


def draw(
    rates: Mapping[str, Mapping[float, float]],
    errors_mm: Mapping[str, Mapping[float, float]],
    num_episodes: int,
    path: Path,
) -> None:
    """Write a PNG of both curves."""
    figure = Figure(figsize=(9.6, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    for axes, curves in ((left, rates), (right, errors_mm)):
        for (name, curve), color in zip(curves.items(), COLORS, strict=False):
            axes.plot(list(curve), list(curve.values()), marker="o", color=color, label=name)
        axes.legend()
    set_up_rates(left, f"success, {num_episodes} episodes each")
    set_up(right, "error of the destination that is read [mm]")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


if __name__ == "__main__":
    main()
