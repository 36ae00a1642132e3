"""Parts of the methods, on and off: what each brings or costs at equal CPU minutes of training.

A version of a policy differs from its base, configs/all_suites_TYPE.yaml, in the flags of one part. All are
trained by the stock `lerobot-train` for the same CPU minutes on one core, from several seeds, and evaluated
by the stock `lerobot-eval` on the same unseen episodes of `place` and `spatial`.

    OMP_NUM_THREADS=1 python benchmarks/methods.py --output_dir=methods

What is finished stays in the output folder and is not done again; a training that was killed goes on. --only
names the parts that are wanted: --only masking chunk.
"""

import argparse
import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np
from learn import FIRST_UNSEEN_SEED, REPO_ID, evaluate, locked, merge, record, run_record
from learning_tasks import Part, Task
from machine import make_parser, parse_on_idle_machine, positive, write_figures
from play_pusht import step_s
from recipes import last_checkpoint, read_recipe, recipe_path

from lerobot_bomb.bootstrap import paired_bootstrap_interval
from lerobot_bomb.commands.run import run_command
from lerobot_bomb.results.bomb import EpisodeResult
from lerobot_bomb.stats import format_bounds
from lerobot_bomb.tables import print_table

RECIPE = "all_suites"
SUITES = "place", "spatial"
FIRST_TRAINING_SEED = 1000
SCENES = Part("spatial", 16_000, is_static=True), Part("place", 4_000, is_static=True)
SHOWN = Part("spatial", 200), Part("place", 100)
RELABELLED_EPISODES = 60
FIRST_RELABELLED_SEED = 400_000
SHARE_BEFORE = 0.6  # of the minutes, before a policy's own episodes are relabelled


@dataclass(frozen=True)
class Data:
    """Recordings to merge, and the environment's flags for recording and evaluating."""

    parts: tuple[Part, ...] = (*SCENES, *SHOWN)
    env_flags: tuple[str, ...] = ()

    def task(self, suite: str) -> Task:
        """Return the task of this data, evaluated on a suite."""
        return Task((), episodes=0, trainings={}, suite=suite, parts=self.parts, env_flags=self.env_flags)


DATA = {
    "scenes": Data(),
    "no_scenes": Data(SHOWN),
    "depth": Data(env_flags=("--env.depth=true",)),
    "absolute": Data(env_flags=("--env.control_mode=absolute",)),
}


@dataclass(frozen=True)
class Version:
    """One way to train a policy type: the flags that differ from its base, and the data."""

    policy_type: str
    flags: tuple[str, ...] = ()
    data: str = "scenes"
    relabels: bool = False  # whether the last of the minutes are spent on its own episodes, relabelled


VLA0, GRID, FDVLA = "vla0_smol", "spatialvla_grid", "fdvla"
DIMS_APART = json.dumps(
    [{"dims": [dim], "transform": "identity", "bins": [bins]} for dim, bins in enumerate((64, 64, 64, 16))]
)
VERSIONS = {
    VLA0: Version(VLA0),
    "vla0_unmasked": Version(VLA0, ("--policy.mask_max_fraction=0",)),
    "vla0_uncropped": Version(VLA0, ("--policy.crop_fraction=1",)),
    "vla0_absolute": Version(VLA0, data="absolute"),
    "vla0_relative": Version(VLA0, ("--policy.relative_actions=true",), data="absolute"),
    GRID: Version(GRID),
    "grid_uniform": Version(GRID, ("--policy.grid_distribution=uniform",)),
    "grid_quantile": Version(GRID, ("--policy.grid_distribution=quantile",)),
    "grid_dims_apart": Version(GRID, (f"--policy.action_groups={DIMS_APART}",)),
    "grid_depth": Version(GRID, ("--policy.depth_source=observation",), data="depth"),
    FDVLA: Version(FDVLA),
    "fdvla_chunk_1": Version(FDVLA, ("--policy.chunk_size=1",)),
    "fdvla_chunk_4": Version(FDVLA, ("--policy.chunk_size=4",)),
    "fdvla_flow": Version(FDVLA, ("--policy.use_denoise_head=false",)),
    "fdvla_noise": Version(FDVLA, ("--policy.use_flow_head=false",)),
    "fdvla_acts_at_once": Version(FDVLA, ("--policy.pointing=false",)),
    "fdvla_adamw": Version(FDVLA, ("--policy.optimizer=adamw",)),
    "fdvla_no_scenes": Version(FDVLA, data="no_scenes"),
    "fdvla_relabelled": Version(FDVLA, relabels=True),
}
# part -> {what it is set to: version}; the first is what the others are compared with
PARTS = {
    "masking": {"off": "vla0_unmasked", "on": VLA0},
    "crop": {"off": "vla0_uncropped", "on": VLA0},
    "relative actions": {"off": "vla0_absolute", "on": "vla0_relative"},
    "grid": {"uniform": "grid_uniform", "Gaussian": GRID, "quantile": "grid_quantile"},
    "tokens": {"one a dimension": "grid_dims_apart", "groups": GRID},
    "Ego3D": {"none": GRID, "true depth": "grid_depth"},
    "chunk": {"1": "fdvla_chunk_1", "4": "fdvla_chunk_4", "8": FDVLA},
    "heads": {"flow": "fdvla_flow", "noise": "fdvla_noise", "both": FDVLA},
    "optimizer": {"AdamW": "fdvla_adamw", "Muon": FDVLA},
    "pointing": {"off": "fdvla_acts_at_once", "on": FDVLA},
    "static scenes": {"off": "fdvla_no_scenes", "on": FDVLA},
    "DAgger": {"off": FDVLA, "on": "fdvla_relabelled"},
}


def main() -> None:
    """Train and evaluate every version of the wanted parts, and print the table."""
    parser = make_parser(__doc__)
    parser.add_argument("--output_dir", type=Path, required=True, help="folder to keep, or to resume in")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS), help="parts of a method")
    parser.add_argument(
        "--minutes", type=positive, default=12, help="CPU minutes of a training (default: 12)"
    )
    parser.add_argument("--seeds", type=positive, default=3, help="trainings of each version (default: 3)")
    parser.add_argument("--episodes", type=positive, default=100, help="of a suite, each (default: 100)")
    args = parse_on_idle_machine(parser)
    args.output_dir.mkdir(parents=True, exist_ok=True)
    wanted = list(dict.fromkeys(name for part in args.only for name in PARTS[part].values()))
    with locked(args.output_dir):
        # seed by seed, so that a table of one training each is there first
        results: dict[str, list[list[EpisodeResult]]] = {name: [] for name in wanted}
        for number in range(args.seeds):
            for name in wanted:
                results[name].append(Run(args, name, FIRST_TRAINING_SEED + number).results())
            print_parts(args.only, results)
    write_figures(args.json, {**figures(results), "minutes": args.minutes, "episodes": args.episodes})


class Run:
    """Training of a version from one seed, in a folder of its own."""

    def __init__(self, args: argparse.Namespace, name: str, seed: int):
        self._version, self._seed, self._episodes = VERSIONS[name], seed, args.episodes
        self._data = DATA[self._version.data]
        self._minutes, self._all = args.minutes, args.output_dir
        self._folder = args.output_dir / f"{name}_{seed}"
        self._pace = args.output_dir / f"{name}.pace.json"

    def results(self) -> list[EpisodeResult]:
        """Do whatever is missing, then return the results of all suites."""
        dataset = self._all / self._version.data / "dataset"
        dataset.parent.mkdir(exist_ok=True)
        record(self._data.task(SUITES[0]), 0, dataset)
        checkpoint = self._train(dataset)
        return [
            result
            for suite in SUITES
            for result in evaluate(
                self._data.task(suite),
                checkpoint,
                self._folder / f"eval_{suite}",
                FIRST_UNSEEN_SEED,
                self._episodes,
            )
        ]

    def _train(self, dataset: Path) -> Path:
        steps, recipe = (
            self._num_steps(dataset),
            f"--config_path={recipe_path(RECIPE, self._version.policy_type)}",
        )
        if not self._version.relabels:
            return self._trained(dataset, self._folder / "train", steps, recipe, *self._version.flags)
        first_steps = round(SHARE_BEFORE * steps)
        before = self._trained(dataset, self._folder / "train", first_steps, recipe, *self._version.flags)
        both = self._folder / "dataset"
        if not both.exists():
            merge([dataset, *(self._relabelled(before, suite) for suite in SUITES)], both)
        lr = read_recipe(RECIPE, self._version.policy_type)["policy"]["optimizer_lr"] / 2
        flags = f"--policy.path={before}", f"--policy.optimizer_lr={lr}", "--batch_size=64", "--num_workers=0"
        return self._trained(both, self._folder / "train_on", steps - first_steps, *flags)

    def _relabelled(self, checkpoint: Path, suite: str) -> Path:
        folder = self._folder / f"relabelled_{suite}"
        if not folder.exists():
            part = Part(suite, RELABELLED_EPISODES, first_seed=FIRST_RELABELLED_SEED)
            run_record(
                self._data.task(suite), folder, part, "--pointing", "--relabel", f"--policy.path={checkpoint}"
            )
        return folder

    def _trained(self, dataset: Path, folder: Path, steps: int, *flags: str) -> Path:
        """Train, or resume a training that was killed; return its last checkpoint."""
        finished = folder.with_suffix(".finished")
        if not finished.exists():
            config = last_checkpoint(folder) / "train_config.json"
            if config.exists():
                run_command("lerobot-train", f"--config_path={config}", "--resume=true")
            else:
                shutil.rmtree(folder, ignore_errors=True)
                run_command(*_train_command(dataset, folder, steps, self._seed), *flags)
            finished.touch()
        return last_checkpoint(folder)

    def _num_steps(self, dataset: Path) -> int:
        """Return how many steps fit into the minutes, by two short trainings."""
        if not self._pace.exists():
            recipe = f"--config_path={recipe_path(RECIPE, self._version.policy_type)}"
            flags = [recipe, *_data_flags(dataset), *self._version.flags]
            self._pace.write_text(json.dumps(step_s(self._all / "pace" / self._pace.stem, flags, "cpu")))
        return round(60 * self._minutes / json.loads(self._pace.read_text()))


def _data_flags(dataset: Path) -> list[str]:
    return [f"--dataset.repo_id={REPO_ID}", f"--dataset.root={dataset}"]


def _train_command(dataset: Path, folder: Path, steps: int, seed: int) -> list[str]:
    return [
        "lerobot-train",
        *_data_flags(dataset),
        f"--output_dir={folder}",
        f"--steps={steps}",
        f"--policy.scheduler_decay_steps={steps}",
        f"--save_freq={max(1, steps // 4)}",
        f"--seed={seed}",
    ]


def episode_means(runs: Sequence[Sequence[EpisodeResult]], suite: str) -> dict[int, float]:
    """Return {seed of an episode: share of the trainings that solved it}."""
    solved: dict[int, list[bool]] = {}
    for result in (result for run in runs for result in run if result.spec.suite == suite):
        solved.setdefault(result.spec.seed, []).append(result.is_success)
    return {seed: mean(each) for seed, each in solved.items()}


def print_parts(names: Sequence[str], results: dict[str, list[list[EpisodeResult]]]) -> None:
    """Print for each part what it is set to, its rates, and the differences over the same episodes."""
    rows = []
    for part in names:
        (first, *_) = PARTS[part].values()
        for setting, version in PARTS[part].items():
            cells = [cell for suite in SUITES for cell in _cells(results[first], results[version], suite)]
            rows.append([part, setting, *cells])
    header = [cell for suite in SUITES for cell in (suite, "each training", "against the first")]
    print_table(["part", "set to", *header], rows)


def _cells(first: list[list[EpisodeResult]], runs: list[list[EpisodeResult]], suite: str) -> list[str]:
    means, with_first = episode_means(runs, suite), episode_means(first, suite)
    each = ", ".join(f"{100 * mean(episode_means([run], suite).values()):.0f}" for run in runs)
    rate = f"{100 * mean(means.values()):.1f} %"
    if runs is first:
        return [rate, each, "-"]
    columns = np.array([(with_first[seed], means[seed]) for seed in means]).T
    ones = np.ones(len(means))
    interval = paired_bootstrap_interval((columns[0], ones), (columns[1], ones))
    points = f"{100 * (columns[1] - columns[0]).mean():+.1f}{format_bounds(interval, '+.1f', 100)}"
    return [rate, each, points]


def figures(results: dict[str, list[list[EpisodeResult]]]) -> dict[str, Any]:
    """Return {version: {suite: rate of each training}} for JSON."""
    return {
        name: {suite: [mean(episode_means([run], suite).values()) for run in runs] for suite in SUITES}
        for name, runs in results.items()
    }


if __name__ == "__main__":
    main()
