"""Suite `place`: one stone onto the intersection that the instruction names."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lerobot_bomb.bomb.board import BOARD, COLORS, NUM_STONES, TRAY_CENTER_XY, Intersection, task_id
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.go import is_legal_move, is_legal_position
from lerobot_bomb.bomb.layout import Layout, put_on_board
from lerobot_bomb.bomb.move import aim_at, one_move
from lerobot_bomb.bomb.streams import Stream, generator
from lerobot_bomb.bomb.suite import Episode, Suite, Turn, draw_template, of_split

STONE = 0  # index of the stone to be moved; stones 1.. stand on the board
MAX_OPENING_STONES = 8
MAX_START_DISTANCE_M = 0.015  # of the stone to be moved from the gripper, horizontally
GRIPPER_START_SPREAD_M = 0.010  # of the gripper around the tray's centre, in x and in y
GRIPPER_START_HEIGHT_M = (0.08, 0.11)  # range of the pads' lower ends above the table

ALL_TARGETS = tuple((row, column) for row in range(BOARD.num_lines) for column in range(BOARD.num_lines))
# One per row and column, so that training still shows every row and every column.
HELDOUT_TARGETS = ((0, 3), (1, 1), (2, 4), (3, 2), (4, 0))
TEMPLATES = (
    "Place a {color} stone on the Go board at row {row}, column {column}.",
    "Put a {color} stone at position ({row}, {column}) on the Go board.",
    "Move the {color} stone to row {row}, column {column} on the board.",
    "Set a {color} stone at ({row}, {column}).",
)
# Forms 1 to 5. `row` and `column` count from 0, row 0 is the far one; `_from_1` counts from 1, `near_`
# from the near edge; `other_` is a place that is not meant.
FORMS = (
    (  # a paraphrase
        "Please place a {color} stone on the Go board at row {row}, column {column}.",
        "Take a {color} stone and put it on the board at row {row}, column {column}.",
        "A {color} stone belongs at row {row}, column {column}. Put it there.",
    ),
    (  # other words, other order
        "In column {column}, row {row} of the grid: one {color} stone, please.",
        "Grab the {color} piece from the tray and leave it where row {row} crosses column {column}.",
        "Where column {column} meets row {row} a {color} piece should lie; bring one there.",
    ),
    (  # clauses that distract
        "Not at row {other_row}, column {other_column}: place a {color} stone at row {row}, column {column}.",
        "There are 5 rows and 5 columns. Never mind what lies there and place a {color} stone at "
        "row {row}, column {column}.",
        "Row {other_row} and column {other_column} can wait. First, a {color} stone at row {row}, "
        "column {column}.",
    ),
    (  # another convention
        "Counting rows and columns from 1, place a {color} stone at row {row_from_1}, "
        "column {column_from_1}.",
        "With row 0 at the near edge of the board, place a {color} stone at row {near_row}, column {column}.",
        "With rows counted from 1 at the near edge and columns from 0, place a {color} stone at "
        "row {near_row_from_1}, column {column}.",
    ),
    (  # a letter and a number, and a clause that distracts
        "Columns are A to E from left to right, rows 1 to 5 from the near edge. Leave {other_letter}"
        "{other_near_row_from_1} alone and place a {color} stone at {letter}{near_row_from_1}.",
        "If rows are 1 to 5 from the far edge and columns A to E from the left, a {color} stone is missing "
        "at {letter}{row_from_1}, not at {other_letter}{other_row_from_1}. Put it there.",
    ),
)


def targets_of(split: str) -> tuple[Intersection, ...]:
    """Intersections (row, column) that a split draws from."""
    return of_split(split, ALL_TARGETS, HELDOUT_TARGETS)


def check_target(spec: EpisodeSpec) -> None:
    """Raise a ValueError if the spec gives a `task_id`, or a target of another split."""
    if spec.task_id is not None:
        raise ValueError("suite 'place' names its tasks by target and colour, not by task_id")
    if spec.target is not None and tuple(spec.target) not in targets_of(spec.split):
        raise ValueError(
            f"--env.target={list(spec.target)} is not in --env.split={spec.split}: split 'heldout' is "
            f"{', '.join(map(str, HELDOUT_TARGETS))}, split 'train' the other intersections"
        )


def _sample_episode(spec: EpisodeSpec) -> Episode:
    """Draw target, colour, instruction, opening and start; the same spec gives the same episode."""
    check_target(spec)
    targets = targets_of(spec.split)
    drawn_target = targets[generator(spec.seed, Stream.TARGET).integers(len(targets))]
    drawn_color = COLORS[generator(spec.seed, Stream.COLOR).integers(len(COLORS))]
    target = (spec.target[0], spec.target[1]) if spec.target is not None else drawn_target
    color = spec.color if spec.color is not None else drawn_color
    template = draw_template(spec, TEMPLATES)
    opening = sample_opening(generator(spec.seed, Stream.OPENING), target, color, MAX_OPENING_STONES)
    return Episode(
        spec=spec,
        task_id=task_id(target, color),
        turns=(Turn(template.format(color=color, row=target[0], column=target[1]), {"color": color}),),
        opening=opening,
        layout=put_on_board(opening, layout_of_one(spec.seed, color)),
        supply=(STONE,),
        plans=((one_move(STONE, [target]),),),
        aims=(aim_at(STONE, target),),
        target=target,
        color=color,
    )


def of_task(spec: EpisodeSpec, number: int) -> EpisodeSpec:
    """Return the spec with target and colour of a numbered task: 25 x colour + 5 x row + column."""
    if spec.target is not None or spec.color is not None:
        raise ValueError("--env.task_ids fixes targets and colours; drop --env.target and --env.color")
    color, point = divmod(number, BOARD.num_lines**2)
    return replace(spec, target=divmod(point, BOARD.num_lines), color=COLORS[color])


def layout_of_one(seed: int, color: str) -> Layout:
    """Draw one stone in the tray, near the gripper; the board is empty."""
    gripper, start = generator(seed, Stream.GRIPPER), generator(seed, Stream.START)
    gripper_xyz = np.array([*TRAY_CENTER_XY, 0.0])
    gripper_xyz[:2] += gripper.uniform(-GRIPPER_START_SPREAD_M, GRIPPER_START_SPREAD_M, 2)
    gripper_xyz[2] = gripper.uniform(*GRIPPER_START_HEIGHT_M)
    # the square root makes the disc uniform
    distance_m = MAX_START_DISTANCE_M * np.sqrt(start.uniform())
    angle_rad = start.uniform(-np.pi, np.pi)

    stone_xy = np.zeros((NUM_STONES, 2))
    stone_is_white = np.zeros(NUM_STONES, dtype=bool)
    stone_xy[STONE] = gripper_xyz[:2] + distance_m * np.array([np.cos(angle_rad), np.sin(angle_rad)])
    stone_is_white[STONE] = color == "white"
    return Layout(gripper_xyz, stone_xy, stone_is_white, np.arange(NUM_STONES) == STONE)


def sample_opening(
    rng: np.random.Generator,
    target: Intersection,
    color: str,
    max_stones: int,
    colors: Sequence[str] = COLORS,
) -> dict[Intersection, str]:
    """{(row, column): colour} of up to `max_stones` stones, colours in turn; position and move are legal.

    The candidates do not depend on the move, and the first that allows it is taken. So the stones on the
    board reveal nothing about the target but that it is free and legal.
    """
    num_stones = rng.integers(max_stones + 1)
    while True:
        chosen = rng.choice(len(ALL_TARGETS), size=num_stones, replace=False)
        first = int(rng.integers(len(COLORS)))
        opening = {ALL_TARGETS[k]: colors[(first + i) % len(colors)] for i, k in enumerate(chosen)}
        if is_legal_position(opening) and is_legal_move(opening, target, color):
            return opening


SUITE = Suite(
    _sample_episode,
    check_target,
    max_steps=100,
    forms=FORMS,
    num_tasks=len(COLORS) * BOARD.num_lines**2,
    of_task=of_task,
)
