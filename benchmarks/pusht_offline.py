r"""Does a policy learn from real data? PushT's human demonstrations, held-out episodes, predictors to beat.

The recipe configs/pusht_TYPE.yaml and its variants, each with several seeds, are trained by the stock
`lerobot-train` on episodes 0-179; `lerobot-bomb checkpoint offline-metrics` measures the decoded actions on
episodes 180-205, beside predictors that look at no image. With --eval_episodes the recipe's checkpoints also
run in LeRobot's environment `pusht`.

All start from one small backbone that first learned to see on the same episodes. From random weights, a model
that may read the state ignores the image for a long time (docs/pusht.md).

    python benchmarks/pusht_offline.py --policy.type=vla0_smol --source pusht_cchi_v7_replay.zarr \
        --output_dir pusht

What is finished stays in the output folder and is not done again: the dataset, each training, each
measurement. Every process uses one thread; a training is two processes, one of which reads the frames.
"""

import argparse
import json
import os
import shutil
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

from machine import add_json_argument, make_parser, positive, write_figures
from pusht_commands import REPO_ID, convert, evaluate, run_logged, train
from pusht_report import Seed, print_report
from recipes import PUSHT_TYPES, last_checkpoint, recipe_path

NUM_TRAIN_EPISODES = 180

# absolute positions that no state tells must be found in the image; the near ones are found first
LOOK_FLAGS = ["--policy.use_state=false", "--policy.optimizer_lr=1.0e-3"]
NEAR_FLAGS = [
    "--policy.chunk_size=4",
    "--policy.n_action_steps=4",
    "--policy.scheduler_decay_steps=2500",
    "--steps=2500",
]
ABSOLUTE = ["--policy.relative_actions=false"]
BASE_STAGES: dict[str, list[list[str]]] = {
    "fdvla": [NEAR_FLAGS],
    "spatialvla_grid": [NEAR_FLAGS],
    "vla0_smol": [[*LOOK_FLAGS, *ABSOLUTE, *NEAR_FLAGS], [*LOOK_FLAGS, *ABSOLUTE]],
}
RECIPE = "recipe"
VARIANTS: dict[str, dict[str, list[str]]] = {
    "fdvla": {RECIPE: []},
    "spatialvla_grid": {RECIPE: []},
    "vla0_smol": {
        RECIPE: [],
        "no_masking": ["--policy.mask_max_fraction=0"],
        "absolute": ABSOLUTE,
        "no_state": ["--policy.use_state=false"],
    },
}


def main() -> None:
    """Convert, train, measure, print the tables; exit with code 1 if a predictor beats the recipe."""
    parser = make_parser(__doc__)
    parser.add_argument("--policy.type", dest="policy_type", required=True, choices=PUSHT_TYPES)
    parser.add_argument("--source", type=Path, help="the zarr; not needed once it is converted")
    parser.add_argument("--output_dir", type=Path, required=True, help="folder to keep, or to resume in")
    parser.add_argument("--variants", nargs="+", help="default: all")
    parser.add_argument("--seeds", type=positive, default=3, help="trainings of each (default: 3)")
    parser.add_argument("--jobs", type=positive, default=2, help="trainings at once (default: 2)")
    parser.add_argument("--frames", type=positive, default=1000, help="held-out frames (default: 1000)")
    parser.add_argument("--eval_episodes", type=positive, help="episodes in the environment, each seed")
    add_json_argument(parser)
    args = parser.parse_args()
    known = VARIANTS[args.policy_type]
    if unknown := set(args.variants or ()) - set(known):
        parser.error(f"--variants: unknown {sorted(unknown)}; choose from {', '.join(known)}")
    os.environ["OMP_NUM_THREADS"] = "1"
    try:
        variants = prove(args, args.variants or list(known))
    except RuntimeError as error:
        sys.exit(f"pusht_offline.py: {error}")
    print(f"\n{args.policy_type}, episodes {NUM_TRAIN_EPISODES}-205, {args.seeds} seeds")
    beaten = print_report(variants, RECIPE)
    figures = {name: [asdict(seed) for seed in seeds] for name, seeds in variants.items()}
    write_figures(args.json, {"policy": args.policy_type, "variants": figures})
    sys.exit(0 if beaten else 1)


def prove(args: argparse.Namespace, chosen: list[str]) -> dict[str, list[Seed]]:
    """Train and measure the chosen variants, {variant: one `Seed` for each seed}."""
    dataset = convert(args.source, args.output_dir / "dataset")
    start = learn_to_see(args.policy_type, dataset, args.output_dir)

    def prove_one(variant: str, number: int) -> Seed:
        folder = args.output_dir / f"{variant}_{number}"
        flags = [f"--seed={number}", *start, *VARIANTS[args.policy_type][variant]]
        checkpoint, minutes = train_once(folder, args.policy_type, dataset, flags)
        validation = measure(checkpoint, folder, dataset, args.frames)["validation"]
        coverages: list[float] = []
        if args.eval_episodes and variant == RECIPE:
            flags = [f"--eval.n_episodes={args.eval_episodes}", "--eval.batch_size=10"]
            coverages, _ = evaluate(checkpoint, folder / f"eval_{args.eval_episodes}", flags)
        return Seed(validation, max_coverages=coverages, **minutes)

    with ThreadPoolExecutor(args.jobs) as pool:
        # seed by seed, so that each variant has been trained once first
        runs = {
            (variant, number): pool.submit(prove_one, variant, number)
            for number in range(args.seeds)
            for variant in chosen
        }
        return {
            variant: [runs[variant, number].result() for number in range(args.seeds)] for variant in chosen
        }


def learn_to_see(policy_type: str, dataset: Path, folder: Path) -> list[str]:
    """Train a backbone to see; return the flags that start a training from it."""
    start: list[str] = []
    for stage, flags in enumerate(BASE_STAGES[policy_type]):
        stage_dir = folder / f"base_{stage}"
        checkpoint, _ = train_once(stage_dir, policy_type, dataset, ["--seed=0", *flags, *start])
        backbone = stage_dir / "backbone"
        if not backbone.exists():
            export = [f"--policy.path={checkpoint}", f"--output={backbone}"]
            run_logged(stage_dir / "export.log", "lerobot-bomb", "checkpoint", "export-backbone", *export)
        start = [f"--policy.vlm_model_name={backbone.resolve()}"]
    return start


def train_once(
    folder: Path, policy_type: str, dataset: Path, flags: list[str]
) -> tuple[Path, dict[str, float]]:
    """Train unless that is done; return the checkpoint and the minutes. A killed training starts anew."""
    times_path = folder / "training.json"
    if not times_path.exists():
        shutil.rmtree(folder, ignore_errors=True)
        data = [
            f"--dataset.repo_id={REPO_ID}",
            f"--dataset.root={dataset}",
            f"--dataset.episodes={list(range(NUM_TRAIN_EPISODES))}",
        ]
        seconds = train(
            folder / "train", [f"--config_path={recipe_path('pusht', policy_type)}", *data, *flags]
        )
        times_path.write_text(json.dumps(seconds.minutes()) + "\n")
    return last_checkpoint(folder / "train"), json.loads(times_path.read_text())


def measure(checkpoint: Path, folder: Path, dataset: Path, num_frames: int) -> dict[str, Any]:
    """Measure with `lerobot-bomb checkpoint offline-metrics` on the episodes that were not trained on."""
    path = folder / f"metrics_{num_frames}.json"
    if not path.exists():
        flags = [
            f"--policy.path={checkpoint}",
            f"--dataset.repo_id={REPO_ID}",
            f"--dataset.root={dataset}",
            f"--max_frames={num_frames}",
            "--batch_size=64",
            f"--json={path}",
        ]
        run_logged(folder / "metrics.log", "lerobot-bomb", "checkpoint", "offline-metrics", *flags)
    return json.loads(path.read_text())["columns"]


if __name__ == "__main__":
    main()
