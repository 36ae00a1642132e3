"""Suite `place`: one stone onto the intersection that the instruction names."""

import numpy as np

from lerobot_bomb.bomb.board import BOARD, COLORS, NUM_STONES, TRAY_CENTER_XY, Cell
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.go import is_legal_move, is_legal_position
from lerobot_bomb.bomb.layout import Layout
from lerobot_bomb.bomb.streams import Stream, generator
from lerobot_bomb.bomb.suite import Episode, Suite

STONE = 0  # index of the stone to be moved; stones 1.. stand on the board
MAX_OPENING_STONES = 8
MAX_START_DISTANCE_M = 0.015  # of the stone to be moved from the gripper, horizontally
GRIPPER_START_SPREAD_M = 0.010  # of the gripper around the tray's centre, in x and in y
GRIPPER_START_HEIGHT_M = (0.08, 0.11)  # range of the pads' lower ends above the table

# One per row and column, so that training still shows every row and every column.
HELDOUT_TARGETS = ((0, 3), (1, 1), (2, 4), (3, 2), (4, 0))
TEMPLATES = (
    "Place a {color} stone on the Go board at row {row}, column {column}.",
    "Put a {color} stone at position ({row}, {column}) on the Go board.",
    "Move the {color} stone to row {row}, column {column} on the board.",
    "Set a {color} stone at ({row}, {column}).",
)
HELDOUT_TEMPLATES = TEMPLATES[3:]


def targets_of(split: str) -> tuple[Cell, ...]:
    """Intersections (row, column) that a split draws from."""
    cells = tuple((row, column) for row in range(BOARD.num_lines) for column in range(BOARD.num_lines))
    if split == "heldout":
        return HELDOUT_TARGETS
    return cells if split == "all" else tuple(cell for cell in cells if cell not in HELDOUT_TARGETS)


def templates_of(split: str) -> tuple[str, ...]:
    """Instruction templates that a split draws from."""
    if split == "heldout":
        return HELDOUT_TEMPLATES
    return TEMPLATES if split == "all" else tuple(t for t in TEMPLATES if t not in HELDOUT_TEMPLATES)


def check_target(spec: EpisodeSpec) -> None:
    """Raise a ValueError unless the spec's target, where it names one, belongs to its split."""
    if spec.target is not None and tuple(spec.target) not in targets_of(spec.split):
        raise ValueError(
            f"--env.target={list(spec.target)} is not in --env.split={spec.split}: split 'heldout' is "
            f"{', '.join(map(str, HELDOUT_TARGETS))}, split 'train' the other intersections"
        )


def sample_episode(spec: EpisodeSpec) -> Episode:
    """Draw target, colour, instruction, opening and start; the same spec, the same episode."""
    check_target(spec)
    targets, templates = targets_of(spec.split), templates_of(spec.split)
    drawn_target = targets[generator(spec.seed, Stream.TARGET).integers(len(targets))]
    drawn_color = COLORS[generator(spec.seed, Stream.COLOR).integers(len(COLORS))]
    target = (spec.target[0], spec.target[1]) if spec.target is not None else drawn_target
    color = spec.color if spec.color is not None else drawn_color
    template = templates[generator(spec.seed, Stream.TEMPLATE).integers(len(templates))]
    opening = _sample_opening(generator(spec.seed, Stream.OPENING), target, color)
    return Episode(
        spec=spec,
        target=target,
        color=color,
        instruction=template.format(color=color, row=target[0], column=target[1]),
        opening=opening,
        layout=_sample_layout(spec.seed, opening, color),
        stone=STONE,
    )


def _sample_layout(seed: int, opening: dict[Cell, str], color: str) -> Layout:
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
    for i, (cell, cell_color) in enumerate(opening.items(), start=STONE + 1):
        stone_xy[i] = BOARD.intersection_xy(*cell)
        stone_is_white[i] = cell_color == "white"
    return Layout(gripper_xyz, stone_xy, stone_is_white, np.arange(NUM_STONES) <= len(opening))


def _sample_opening(rng: np.random.Generator, target: Cell, color: str) -> dict[Cell, str]:
    """{(row, column): colour} of 0-8 stones: a legal position in which the move to be made is legal.

    The candidates do not depend on the move and the first that allows it is taken, so what stands on the
    board tells nothing of the target but that it is free and legal.
    """
    cells = targets_of("all")
    num_stones = rng.integers(MAX_OPENING_STONES + 1)
    while True:
        chosen = rng.choice(len(cells), size=num_stones, replace=False)
        first = rng.integers(len(COLORS))
        opening = {cells[k]: COLORS[(first + i) % len(COLORS)] for i, k in enumerate(chosen)}
        if is_legal_position(opening) and is_legal_move(opening, target, color):
            return opening


SUITE = Suite(sample_episode, check_target, max_steps=100)
