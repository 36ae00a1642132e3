"""Time to read a sample of a dataset of images, with LeRobot alone and with the plugin.

    lerobot-bomb record --repo_id=me/b --root=data/b --episodes=100 --images --env.image_size=64 --pointing
    OMP_NUM_THREADS=1 python benchmarks/read_speed.py --dataset.repo_id=me/b --dataset.root=data/b

Samples have a chunk of 8 actions and are drawn at random. Times are CPU times of the only process. The plugin
decodes an image when it is first asked for, and then keeps it.
"""

import random
import time
from pathlib import Path
from typing import Any

import torch
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION
from machine import make_parser, milliseconds, parse_on_idle_machine, positive, print_rows, write_figures

from lerobot_bomb.compat.hooks.datasets import keep_frames_in_memory
from lerobot_bomb.data.kept_frames import keep_frames

CHUNK = 8


def main() -> None:
    """Read the same samples in three ways, check that they are equal, print milliseconds a sample."""
    parser = make_parser(__doc__)
    parser.add_argument("--dataset.repo_id", dest="repo_id", required=True)
    parser.add_argument("--dataset.root", dest="root", type=Path, required=True)
    parser.add_argument("--samples", type=positive, default=300)
    args = parse_on_idle_machine(parser)
    times = {ACTION: [step / LeRobotDatasetMetadata(args.repo_id, args.root).fps for step in range(CHUNK)]}
    stock = LeRobotDataset(args.repo_id, args.root, delta_timestamps=times)
    keep_frames_in_memory(keep_frames)
    ours = LeRobotDataset(args.repo_id, args.root, delta_timestamps=times)
    rows = random.Random(0).sample(range(len(stock)), min(args.samples, len(stock)))
    loading = milliseconds(lambda: ours[rows[0]], time.process_time)
    samples: list[list[Any]] = []
    figures = {}
    for name, dataset in (("LeRobot", stock), ("plugin, decodes", ours), ("plugin, again", ours)):
        read: list[Any] = []
        spent = milliseconds(
            lambda dataset=dataset, read=read: read.extend(dataset[row] for row in rows), time.process_time
        )
        figures[name] = {"ms_a_sample": spent / len(rows)}
        samples.append(read)
    if not all(map(equal, samples[0], samples[1])) or not all(map(equal, samples[0], samples[2])):
        raise SystemExit("The samples differ.")
    for row in figures.values():
        row["ratio"] = figures["LeRobot"]["ms_a_sample"] / row["ms_a_sample"]
    print_rows(f"{len(rows)} of {len(stock)} samples", figures)
    print(f"once, to read all numbers: {loading / 1e3:.1f} s")
    write_figures(args.json, {"samples": figures, "loading_s": loading / 1e3})


def equal(first: dict, second: dict) -> bool:
    """Return True if two samples hold the same bits."""
    return first.keys() == second.keys() and all(
        torch.equal(value, second[key]) if isinstance(value, torch.Tensor) else value == second[key]
        for key, value in first.items()
    )


if __name__ == "__main__":
    main()
