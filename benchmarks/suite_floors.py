"""What policies that miss something would reach on a suite, so that a success rate can be read.

    python benchmarks/suite_floors.py --json suite_floors.json

Each of them is taken to move perfectly what it has chosen; nothing is simulated. `random` sees neither
instruction nor images: any stone of the tray, any intersection. `most likely place` does too, but knows where
targets are most frequent. `no instruction` sees which intersections are free and legal. `no colours` reads
and sees everything but the stones' colours: it takes the answer that the instruction has under colours drawn
at random, such that it has one.
"""

import argparse
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from machine import positive, write_figures

from lerobot_bomb.bomb.board import COLORS, Cell
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.go import is_legal_move
from lerobot_bomb.bomb.suite import Episode, find_suite
from lerobot_bomb.bomb.suites import SUITES
from lerobot_bomb.bomb.suites import object as object_suite
from lerobot_bomb.bomb.suites import spatial as spatial_suite
from lerobot_bomb.bomb.suites.place import ALL_TARGETS
from lerobot_bomb.tables import print_table

FIRST_SEED = 100_000
KNOWN_SEEDS = range(5000)  # from which the most likely place is known


def main() -> None:
    """Print a row for each suite; chances in per cent."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--episodes", type=positive, default=2000, help="of each suite (default: 2000)")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    args = parser.parse_args()
    figures = {suite: floors(suite, args.episodes) for suite in SUITES}
    names = list(next(iter(figures.values())))
    print_table(
        [f"{args.episodes} episodes, %", *names],
        [[suite, *(f"{100 * row[name]:.1f}" for name in names)] for suite, row in figures.items()],
    )
    write_figures(args.json, figures)


def floors(suite: str, num_episodes: int) -> dict[str, float]:
    """{what is missing: success rate}."""
    sample = find_suite(suite).sample
    known = Counter(sample(EpisodeSpec(seed, suite)).target for seed in KNOWN_SEEDS)
    ((likely, _),) = known.most_common(1)
    rng = np.random.default_rng(0)
    chances: dict[str, list[float]] = {
        "random": [], "most likely place": [], "no instruction": [], "no colours": []
    }  # fmt: skip
    for seed in range(FIRST_SEED, FIRST_SEED + num_episodes):
        episode = sample(EpisodeSpec(seed, suite))
        num_stones = len(episode.supply)
        chances["random"].append(1 / num_stones / len(ALL_TARGETS))
        chances["most likely place"].append((episode.target == likely) / num_stones)
        chances["no instruction"].append(
            sum(1 / len(legal(episode, stone)) for stone in episode.supply) / num_stones**2
        )
        chances["no colours"].append(
            float(answer_without_colours(episode, rng) == (episode.stone, episode.target))
        )
    return {name: float(np.mean(values)) for name, values in chances.items()}


def legal(episode: Episode, stone: int) -> list[Cell]:
    """Where a stone of the tray may be put."""
    color = COLORS[int(episode.layout.stone_is_white[stone])]
    cells = [cell for cell in ALL_TARGETS if is_legal_move(dict(episode.opening), cell, color)]
    return cells or list(ALL_TARGETS)


def answer_without_colours(episode: Episode, rng: np.random.Generator) -> tuple[int, Cell]:
    """(stone, place) that the instruction means where the stones have other colours."""
    suite, layout = episode.spec.suite, episode.layout
    if suite == "object":
        task, supply = object_suite.TASKS[episode.task_id], list(episode.supply)
        stone = None
        while stone is None:
            is_white = rng.integers(2, size=len(supply)) == 1
            stone = task.select(
                object_suite.Supply(layout.stone_xy[supply], is_white, layout.gripper_xyz[:2])
            )
        return stone, episode.target
    if suite == "spatial":
        task, anchor = spatial_suite.TASKS[episode.task_id], COLORS[1 - COLORS.index(episode.color)]
        place = None
        while place is None:
            place = task.select(recoloured(episode.opening, rng), anchor)
        return episode.stone, place
    return episode.stone, episode.target  # one stone, whose place is named by numbers


def recoloured(opening: Mapping[Cell, str], rng: np.random.Generator) -> dict[Cell, str]:
    """The stones on the board in colours drawn at random."""
    return {cell: COLORS[rng.integers(2)] for cell in opening}


if __name__ == "__main__":
    main()
