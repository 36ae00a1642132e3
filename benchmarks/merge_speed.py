"""Seconds in which blocks of a recording become one dataset, beside LeRobot's own merge.

A block of 20 episodes is recorded once and copied. LeRobot's merge writes a file again for every block that
it adds to it; ours writes it once.

    OMP_NUM_THREADS=1 python benchmarks/merge_speed.py --blocks=25,100,400 --json merge_speed.json
"""

import argparse
import shutil
import tempfile
import time
from contextlib import nullcontext
from pathlib import Path

from machine import add_machine_arguments, require_idle_machine, write_figures

from lerobot_bomb.commands.arguments import parse_numbers
from lerobot_bomb.data.kept_blocks import block_path
from lerobot_bomb.data.recorded_blocks import Players, record_blocks, recording_layout
from lerobot_bomb.data.recording import Recording
from lerobot_bomb.tables import print_table

OURS, LEROBOTS = "lerobot-bomb record --join", "LeRobot's merge"


def main() -> None:
    """Merge more and more blocks either way, print seconds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--blocks", type=parse_numbers, default=(25, 100, 400), help="numbers of them")
    parser.add_argument("--images", action="store_true", help="images instead of videos")
    add_machine_arguments(parser)
    args = parser.parse_args()
    require_idle_machine(args.force)
    recording = Recording("benchmark/merge", 20, image_size=64, images=args.images)
    seconds: dict[str, dict[int, float]] = {OURS: {}, LEROBOTS: {}}
    with tempfile.TemporaryDirectory() as folder:
        record_blocks(recording, Path(folder), Players(), range(1))
        first = block_path(Path(folder), 0)
        blocks = [first, *(first.with_name(f"copy-{number}") for number in range(1, max(args.blocks)))]
        for copy in blocks[1:]:
            shutil.copytree(first, copy)
        for name, of_numbers in seconds.items():
            for number in args.blocks:
                of_numbers[number] = seconds_of(name, recording, blocks[:number], Path(folder) / "merged")
    numbers = sorted(args.blocks)
    rows = [[name, *(f"{found[number]:.1f}" for number in numbers)] for name, found in seconds.items()]
    print_table(["seconds for blocks", *map(str, numbers)], rows)
    write_figures(args.json, {"images": args.images, "seconds": seconds})


def seconds_of(name: str, recording: Recording, blocks: list[Path], root: Path) -> float:
    """Merge blocks once."""
    from lerobot_bomb.data import blocks as merging

    usual = merging.merged_at_once
    merging.merged_at_once = usual if name == OURS else nullcontext
    started = time.perf_counter()
    try:
        merging.merge_blocks(recording_layout(recording), blocks, root)
    finally:
        merging.merged_at_once = usual
    elapsed = time.perf_counter() - started
    shutil.rmtree(root)
    return elapsed


if __name__ == "__main__":
    main()
