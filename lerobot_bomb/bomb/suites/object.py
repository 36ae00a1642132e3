"""Suite `object`: two to four stones lie in the tray; the instruction says which one is meant."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

import numpy as np

from lerobot_bomb.bomb.board import COLORS, NUM_STONES, TRAY_CENTER_XY, Intersection
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.layout import Layout, put_on_board
from lerobot_bomb.bomb.move import aim_at, one_move
from lerobot_bomb.bomb.streams import Stream, generator
from lerobot_bomb.bomb.suite import Episode, Suite, Turn, draw_template, of_split, refuse_options
from lerobot_bomb.bomb.suites.place import ALL_TARGETS, sample_opening

MAX_OPENING_STONES = 5
MIN_SUPPLY, MAX_SUPPLY = 2, 4
# Each stone of the supply lies in a corner of a rectangle around the tray's centre, at distances
# in these ranges: fingers fit between two stones, and the axis `start` keeps them all on the tray.
CORNER_X_M = (0.023, 0.030)
CORNER_Y_M = (0.023, 0.026)
GRIPPER_START_SPREAD_M = 0.030  # of the gripper around the tray's centre, in x and in y
GRIPPER_START_HEIGHT_M = (0.08, 0.11)
# how much nearer, further left, ... the stone that is meant is than any other; visible at 64 pixels
MARGIN_M = 0.012

TEMPLATES = (
    "Place {stone} on the Go board at row {row}, column {column}.",
    "Put {stone} at position ({row}, {column}) on the Go board.",
    "Move {stone} to row {row}, column {column} on the board.",
    "Set {stone} at ({row}, {column}).",
)
FORMS = (
    (
        "Please place {stone} on the Go board at row {row}, column {column}.",
        "Take {stone} and put it on the board at row {row}, column {column}.",
    ),
    (
        "In column {column}, row {row} of the grid: {stone}, please.",
        "Grab {stone} and leave it where row {row} crosses column {column}.",
    ),
    (
        "Not at row {other_row}, column {other_column}: place {stone} at row {row}, column {column}.",
        "There are 5 rows and 5 columns. Never mind what lies there and place {stone} at row {row}, "
        "column {column}.",
    ),
    (
        "Counting rows and columns from 1, place {stone} at row {row_from_1}, column {column_from_1}.",
        "With row 0 at the near edge of the board, place {stone} at row {near_row}, column {column}.",
    ),
    (
        "Columns are A to E from left to right, rows 1 to 5 from the near edge. Leave {other_letter}"
        "{other_near_row_from_1} alone and place {stone} at {letter}{near_row_from_1}.",
        "If rows are 1 to 5 from the far edge and columns A to E from the left, place {stone} at "
        "{letter}{row_from_1}, not at {other_letter}{other_row_from_1}.",
    ),
)


@dataclass(frozen=True)
class Supply:
    """The stones in the tray, and the gripper above them."""

    xy: np.ndarray  # (n, 2) metres
    is_white: np.ndarray  # (n,) bool
    gripper_xy: np.ndarray  # (2,) metres


@dataclass(frozen=True)
class StoneTask:
    """Task about one stone in the tray: `select` returns its index, None if it is unclear which."""

    stone: str
    select: Callable[[Supply], int | None]
    gripper_is_named: bool = False


def _only(supply: Supply, is_white: bool) -> int | None:
    found = np.flatnonzero(supply.is_white == is_white)
    return int(found[0]) if len(found) == 1 else None


def _least(values: np.ndarray) -> int | None:
    """Index of the value that is clearly the least."""
    order = np.argsort(values)
    return int(order[0]) if values[order[1]] - values[order[0]] >= MARGIN_M else None


def _nearest_to_gripper(supply: Supply) -> int | None:
    return _least(np.linalg.norm(supply.xy - supply.gripper_xy, axis=1))


def _by_anchor(supply: Supply, is_white: bool, sign: int) -> int | None:
    """Return the stone nearest to a colour's only stone, or farthest from it; None with fewer than three."""
    anchor = _only(supply, is_white)
    if anchor is None or len(supply.xy) < 3:
        return None
    distances = sign * np.linalg.norm(supply.xy - supply.xy[anchor], axis=1)
    distances[anchor] = np.inf
    return _least(distances)


def _by_side(supply: Supply, axis: int, sign: int) -> int | None:
    return _least(sign * supply.xy[:, axis])


TASKS = (
    StoneTask("the black stone", partial(_only, is_white=False)),
    StoneTask("the white stone", partial(_only, is_white=True)),
    # the gripper comes nearer to it and nearer to no other: it is the same stone in every step
    StoneTask("the stone nearest to the gripper", _nearest_to_gripper, gripper_is_named=True),
    StoneTask("the frontmost stone in the tray", partial(_by_side, axis=1, sign=1)),
    StoneTask("the stone nearest to the white stone", partial(_by_anchor, is_white=True, sign=1)),
    StoneTask("the stone farthest from the white stone", partial(_by_anchor, is_white=True, sign=-1)),
    StoneTask("the stone nearest to the black stone", partial(_by_anchor, is_white=False, sign=1)),
    StoneTask("the stone farthest from the black stone", partial(_by_anchor, is_white=False, sign=-1)),
    StoneTask("the leftmost stone in the tray", partial(_by_side, axis=0, sign=1)),
    StoneTask("the rightmost stone in the tray", partial(_by_side, axis=0, sign=-1)),
)
NUM_PARTS = 5  # one in so many pairs of a task and an intersection is held out


def _is_heldout(task_id: int, intersection: Intersection) -> bool:
    """Return True if a pair is held out; every task and every intersection is seen in other pairs."""
    row, column = intersection
    return (task_id + row + 2 * column) % NUM_PARTS == 0


@cache
def pairs_of_split(split: str) -> tuple[tuple[int, Intersection], ...]:
    """Return the pairs (task, target) that a split draws from."""
    pairs = [(task_id, intersection) for task_id in range(len(TASKS)) for intersection in ALL_TARGETS]
    return of_split(split, pairs, [pair for pair in pairs if _is_heldout(*pair)])


def _pairs(spec: EpisodeSpec) -> list[tuple[int, Intersection]]:
    """Return the pairs of task and intersection that a spec draws from."""
    return [
        (task_id, intersection)
        for task_id, intersection in pairs_of_split(spec.split)
        if spec.task_id in (None, task_id) and (spec.target is None or tuple(spec.target) == intersection)
    ]


def _check(spec: EpisodeSpec) -> None:
    """Raise a ValueError that names the flag unless the spec has an episode."""
    refuse_options(spec, "color")
    if not _pairs(spec):
        raise ValueError(
            f"--env.target={list(spec.target or ())} with task {spec.task_id} is not in "
            f"--env.split={spec.split}, which is of other pairs of a task and an intersection"
        )


def _sample_episode(spec: EpisodeSpec) -> Episode:
    """Draw task, target, supply, opening and start; the same spec gives the same episode."""
    _check(spec)
    pairs = _pairs(spec)
    task_id, target = pairs[generator(spec.seed, Stream.TARGET).integers(len(pairs))]
    task = TASKS[task_id]
    supply, stone, height_m = _sample_supply(generator(spec.seed, Stream.SUPPLY), task)
    color = COLORS[int(supply.is_white[stone])]
    template = draw_template(spec, TEMPLATES)
    opening = sample_opening(generator(spec.seed, Stream.OPENING), target, color, MAX_OPENING_STONES)
    return Episode(
        spec=spec,
        task_id=task_id,
        turns=(
            Turn(template.format(stone=task.stone, row=target[0], column=target[1]), {"stone": task.stone}),
        ),
        opening=opening,
        layout=put_on_board(opening, _layout(supply, height_m)),
        supply=tuple(range(len(supply.xy))),
        plans=((one_move(stone, [target]),),),
        aims=(aim_at(stone, target),),
        target=target,
        color=color,
        gripper_is_named=task.gripper_is_named,
    )


def _sample_supply(rng: np.random.Generator, task: StoneTask) -> tuple[Supply, int, float]:
    """Draw the supply; return it, the index of the stone that is meant and the gripper's height in metres."""
    height_m = rng.uniform(*GRIPPER_START_HEIGHT_M)
    corners = np.array([(x, y) for x in (-1, 1) for y in (-1, 1)])
    while True:
        number = rng.integers(MIN_SUPPLY, MAX_SUPPLY + 1)
        chosen = corners[rng.permutation(len(corners))[:number]]
        away_m = np.column_stack([rng.uniform(*CORNER_X_M, number), rng.uniform(*CORNER_Y_M, number)])
        supply = Supply(
            TRAY_CENTER_XY + chosen * away_m,
            rng.integers(2, size=number) == 1,
            TRAY_CENTER_XY + rng.uniform(-GRIPPER_START_SPREAD_M, GRIPPER_START_SPREAD_M, 2),
        )
        stone = task.select(supply)
        if stone is not None:
            return supply, stone, height_m


def _layout(supply: Supply, height_m: float) -> Layout:
    number = len(supply.xy)
    stone_xy, is_white = np.zeros((NUM_STONES, 2)), np.zeros(NUM_STONES, dtype=bool)
    stone_xy[:number], is_white[:number] = supply.xy, supply.is_white
    gripper_xyz = np.array([*supply.gripper_xy, height_m])
    return Layout(gripper_xyz, stone_xy, is_white, np.arange(NUM_STONES) < number)


# 1.1: task 3 names a stone that stays the same while the gripper moves
SUITE = Suite(_sample_episode, _check, max_steps=100, forms=FORMS, num_tasks=len(TASKS), version="1.1")
