"""``lerobot-bomb demo``: evaluate a policy that comes with the package, by LeRobot's own commands."""

import argparse
import json
import time
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from lerobot_bomb.bomb.episode import TEST_SEEDS
from lerobot_bomb.bomb.perturbations import Condition
from lerobot_bomb.commands.arguments import path_flag
from lerobot_bomb.commands.run import run_command
from lerobot_bomb.conditions import NONE
from lerobot_bomb.files import check_new_folder
from lerobot_bomb.results.bomb import EpisodeResult
from lerobot_bomb.results.groups import by_condition, rate_of, read_results
from lerobot_bomb.results.names import SHIPPED_PREFIX
from lerobot_bomb.sweep.manifest import largest_divisor
from lerobot_bomb.tables import print_table

POLICY = "vla0_smol"
# one axis, and all ten at once: the policy was trained on both, and fails under the second
CONDITIONS = (Condition(), Condition("light:3"), Condition("all:3"))
SUITE = "place"


@dataclass(frozen=True)
class DemoPolicy:
    """Policy of the demo, and the conditions of its evaluation."""

    policy_flag: str
    conditions: tuple[str, ...] = CONDITIONS


POLICIES = {
    POLICY: DemoPolicy(f"--policy.path={SHIPPED_PREFIX}{POLICY}"),
    "expert": DemoPolicy("--policy.type=bomb_expert"),
    "random": DemoPolicy("--policy.type=bomb_random", (NONE,)),
}
IMAGE_SIZE = 64  # pixels, as it was trained with
SEED = TEST_SEEDS[0]  # LeRobot's default; no demonstration had it
SHOWN_EPISODES = 4  # of a condition
MAX_EVAL_BATCH = 10
FRAME_WIDTH = 384  # pixels, of a tile
SHEET_LABEL_WIDTH = 60  # pixels
SUCCESS_RGB, FAILURE_RGB = (40, 140, 40), (190, 40, 40)  # of an edge above a tile
EDGE = 6  # pixels, its height
CLOSING = """\
{policy} is a small model, trained from scratch on one CPU core; docs/results.md says what it can do.
Next:
  train one yourself, in minutes   make demo-train
  your own checkpoint              lerobot-eval --policy.path=FOLDER --env.type=bomb ... (docs/benchmark.md)
  every perturbation               docs/perturbations.md"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("--output_dir", type=path_flag, help="new folder (default: outputs/demo/DATE_TIME)")
    parser.add_argument("--episodes", type=int, default=20, help="episodes of each condition (default: 20)")


def run(args: argparse.Namespace) -> int:
    """Evaluate, replay a failure, print rates; the last line is the contact sheet's path."""
    if args.episodes < 1:
        raise ValueError(f"--episodes={args.episodes} must be at least 1")
    output_dir = args.output_dir or Path("outputs/demo") / f"{datetime.now():%Y-%m-%d_%H-%M-%S}"
    check_new_folder("--output_dir", output_dir)
    started = time.monotonic()
    records = {}
    for number, (name, policy) in enumerate(POLICIES.items(), start=1):
        conditions = ", ".join(policy.conditions)
        _say(f"{number}/{len(POLICIES) + 1}  evaluate {name}, {args.episodes} episodes each of: {conditions}")
        records[name] = _evaluate(output_dir, name, policy, args.episodes)
    shown = next((each for each in records[POLICY] if not each.is_success), records[POLICY][-1])
    outcome = shown.failure or "success"
    _say(f"{len(POLICIES) + 1}/{len(POLICIES) + 1}  Replay an episode of {POLICY}: {outcome}")
    _replay(output_dir, shown)
    _report(output_dir, records, time.monotonic() - started)
    return 0


def _evaluate(output_dir: Path, name: str, policy: DemoPolicy, num_episodes: int) -> list[EpisodeResult]:
    results = output_dir / f"{name}.jsonl"
    run_command(
        "lerobot-eval",
        policy.policy_flag,
        "--policy.device=cpu",
        "--env.type=bomb",
        f"--env.task={SUITE}",
        f"--env.image_size={IMAGE_SIZE}",
        f"--env.perturbations={json.dumps(policy.conditions)}",
        f"--env.results_path={results}",
        f"--seed={SEED}",
        f"--eval.n_episodes={num_episodes}",
        f"--eval.batch_size={largest_divisor(num_episodes, MAX_EVAL_BATCH)}",
        "--eval.use_async_envs=false",
        f"--output_dir={output_dir / 'eval' / name}",
    )
    return read_results(results, EpisodeResult)


def _replay(output_dir: Path, record: EpisodeResult) -> None:
    run_command(
        "lerobot-bomb",
        "view",
        POLICIES[POLICY].policy_flag,
        f"--seed={record.spec.seed}",
        f"--env.perturbations={record.spec.perturbations}",
        f"--output={output_dir / 'replay'}",
    )


def _report(output_dir: Path, records: dict[str, list[EpisodeResult]], seconds: float) -> None:
    _say(f"Done in {seconds / 60:.1f} minutes: successes, with 95 % Wilson intervals")
    cells = []
    for name, evaluated in records.items():
        by = by_condition(evaluated)
        cells.append([name, *(_rate(by.get(condition, [])) for condition in CONDITIONS)])
    print_table(["", *CONDITIONS], cells)
    print(f"\n{CLOSING.format(policy=POLICY)}\n")
    print(f"results        {output_dir}/*.jsonl  (lerobot-bomb results FILE)")
    print(f"videos         {output_dir}/eval/*/videos")
    print(f"replay         {output_dir}/replay.mp4, and .rrd for Rerun")
    print(f"contact sheet  {_write_sheet(output_dir, records[POLICY])}")


def _rate(records: list[EpisodeResult]) -> str:
    return str(rate_of(records)) if records else "-"


def _write_sheet(output_dir: Path, records: list[EpisodeResult]) -> Path:
    """Write the last frames of some episodes of each condition, with their outcomes."""
    from PIL import Image

    from lerobot_bomb.viewing.sheet import Sheet

    tiles: dict[str, list[np.ndarray]] = {}
    in_order = sorted(records, key=lambda record: record.spec.seed)
    for condition, evaluated in by_condition(in_order).items():
        group = f"{SUITE}.{condition.key}_0"  # of LeRobot's videos
        folder = output_dir / "eval" / POLICY / "videos" / group
        tiles[condition] = [
            _tile(folder / f"eval_episode_{number}.mp4", record)
            for number, record in enumerate(evaluated[:SHOWN_EPISODES])
        ]
    columns = [f"seed {SEED + number}" for number in range(len(tiles[NONE]))]
    path = output_dir / f"{POLICY}.png"
    title = f"{POLICY}: how episodes end (the last frame of each video); green: success, red: failure"
    Image.fromarray(Sheet(title, columns, images=tiles, label_width=SHEET_LABEL_WIDTH).draw()).save(path)
    return path


def _tile(video: Path, record: EpisodeResult) -> np.ndarray:
    """(H, W, 3) images of both cameras above a caption that is legible at this size, unlike the video's."""
    from PIL import Image

    from lerobot_bomb.viewing.sheet import caption
    from lerobot_bomb.viewing.video import last_frame

    frame = Image.fromarray(last_frame(video))
    cameras = frame.crop((0, 0, frame.width, frame.width // 2)).resize((FRAME_WIDTH, FRAME_WIDTH // 2))
    outcome = f"{record.failure or 'success'}, {record.placement_error_mm:.1f} mm from the intersection"
    tile = np.concatenate([np.array(cameras), caption(record.instruction, outcome, FRAME_WIDTH)])
    tile[:EDGE] = SUCCESS_RGB if record.is_success else FAILURE_RGB
    return tile


def _say(text: str) -> None:
    print(f"\n=== {text}", flush=True)
