"""Success rates on a suite of policies that lack one ability, to compare a measured rate with.

    python benchmarks/suite_floors.py --json suite_floors.json

Each is assumed to carry out its choice perfectly; nothing is simulated. `most likely` neither reads nor sees:
it does what is right most often. `no instruction` sees the board and takes anything that could be asked for
there. `no colours` reads and sees everything but the stones' colours: it does what the instruction means
under random colours, drawn until it means something.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from machine import add_json_argument, make_parser, positive, print_rows, write_figures

from lerobot_bomb.bomb.board import COLORS, Intersection
from lerobot_bomb.bomb.commands import Case, Stones, Task, TaskInstance, draw_command
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.go import is_legal_move
from lerobot_bomb.bomb.suite import Episode, find_suite
from lerobot_bomb.bomb.suites import SUITES
from lerobot_bomb.bomb.suites import goal as goal_suite
from lerobot_bomb.bomb.suites import long as long_suite
from lerobot_bomb.bomb.suites import object as object_suite
from lerobot_bomb.bomb.suites import spatial as spatial_suite
from lerobot_bomb.bomb.suites.place import ALL_TARGETS

FIRST_SEED = 100_000
KNOWN_SEEDS = range(5000)  # from which the most likely place is known
NUM_GUESSES = 60  # drawn for each verb: what it could be about
MAX_TRIES = 200  # of colours
COMMANDS = {"goal": goal_suite.TASKS, "long": long_suite.TASKS}

type Floors = dict[str, float]  # {missing ability: success rate}


def main() -> None:
    """Print a row for each suite; chances in per cent."""
    parser = make_parser(__doc__)
    parser.add_argument("--episodes", type=positive, default=2000, help="of each suite (default: 2000)")
    add_json_argument(parser)
    args = parser.parse_args()
    seeds = range(FIRST_SEED, FIRST_SEED + args.episodes)
    figures = {
        suite: floors_of_commands(suite, seeds) if suite in COMMANDS else floors_of_places(suite, seeds)
        for suite in SUITES
    }
    percent = {suite: {name: 100 * rate for name, rate in row.items()} for suite, row in figures.items()}
    print_rows(f"{args.episodes} episodes, %", percent)
    write_figures(args.json, figures)


def floors_of_places(suite: str, seeds: Sequence[int]) -> Floors:
    """Return the floors of a suite whose episodes are one stone to one place."""
    sample = find_suite(suite).sample
    known = Counter(sample(EpisodeSpec(seed, suite)).target for seed in KNOWN_SEEDS)
    ((likely, _),) = known.most_common(1)
    rng = np.random.default_rng(0)
    chances: dict[str, list[float]] = {"most likely": [], "no instruction": [], "no colours": []}
    for seed in seeds:
        episode = sample(EpisodeSpec(seed, suite))
        num_stones = len(episode.supply)
        chances["most likely"].append((episode.target == likely) / num_stones)
        chances["no instruction"].append(
            sum(1 / len(legal(episode, stone)) for stone in episode.supply) / num_stones**2
        )
        chances["no colours"].append(
            float(answer_without_colours(episode, rng) == (episode.aims[0].stone, episode.target))
        )
    return {name: float(np.mean(values)) for name, values in chances.items()}


def floors_of_commands(suite: str, seeds: Sequence[int]) -> Floors:
    """Return the floors of a suite whose instructions are commands."""
    tasks, rng = COMMANDS[suite], np.random.default_rng(0)
    shares, colourless = [], []
    for seed in seeds:
        task_id, drawn, case = draw_command(tasks, EpisodeSpec(seed, suite))
        of_tasks = np.array([share_of_guesses(task, drawn, case, rng) for task in tasks])
        if np.isnan(of_tasks[task_id]):
            of_tasks[task_id] = 0.0  # the verb can be about so many things that no guess fits this board
        shares.append(of_tasks)
        colourless.append(float(plans_without_colours(tasks[task_id], drawn, rng) == case.plans))
    each = np.array(shares)  # (episodes, tasks), nan: the verb makes no sense there
    return {
        # always the same verb
        "most likely": float(np.nan_to_num(each).mean(axis=0).max()),
        "no instruction": float(np.mean([np.mean(row[~np.isnan(row)]) for row in each])),
        "no colours": float(np.mean(colourless)),
    }


def share_of_guesses(task: Task, drawn: TaskInstance, case: Case, rng: np.random.Generator) -> float:
    """Return the share of a verb's possible meanings on this board with the same plans; NaN if none fits."""
    abouts = {task.draw(rng).about for _ in range(NUM_GUESSES)}
    guesses = [task.case(replace(drawn, about=about)) for about in sorted(abouts)]
    fitting = [guess for guess in guesses if guess is not None]
    return float(np.mean([guess.plans == case.plans for guess in fitting])) if fitting else float("nan")


def plans_without_colours(task: Task, drawn: TaskInstance, rng: np.random.Generator) -> tuple | None:
    """Return a command's plans under random stone colours; None if it has none under those tried."""
    for _ in range(MAX_TRIES):
        supply = tuple(COLORS[i] for i in rng.integers(2, size=len(drawn.supply)))
        pattern = recoloured(drawn.pattern, rng)
        stones = recoloured(drawn.stones, rng)
        if case := task.case(replace(drawn, stones=stones, supply=supply, pattern=pattern)):
            return case.plans
    return None


def legal(episode: Episode, stone: int) -> list[Intersection]:
    """Return the intersections where a stone of the tray may be put."""
    color = COLORS[int(episode.layout.stone_is_white[stone])]
    intersections = [
        intersection for intersection in ALL_TARGETS if is_legal_move(episode.opening, intersection, color)
    ]
    return intersections or list(ALL_TARGETS)


def answer_without_colours(episode: Episode, rng: np.random.Generator) -> tuple[int, Intersection | None]:
    """Return the (stone, place) that the instruction means under random stone colours."""
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
        task, color = spatial_suite.TASKS[episode.task_id], episode.color or COLORS[0]
        place = None
        while place is None:
            place = task.select(recoloured(episode.opening, rng), COLORS[1 - COLORS.index(color)])
        return episode.aims[0].stone, place
    return episode.aims[0].stone, episode.target  # one stone, whose place is named by numbers


def recoloured(opening: Stones, rng: np.random.Generator) -> dict[Intersection, str]:
    """Return the stones on the board in random colours."""
    return {intersection: COLORS[rng.integers(2)] for intersection in opening}


if __name__ == "__main__":
    main()
