"""Suites whose instruction is a command: a verb and its arguments, on the board of the episode."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import count

import numpy as np

from lerobot_bomb.bomb.board import BOARD, COLORS, NUM_STONES, TRAY_CENTER_XY, Intersection
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.go import is_legal_position
from lerobot_bomb.bomb.layout import Layout, put_on_board
from lerobot_bomb.bomb.move import Aim, Plan
from lerobot_bomb.bomb.streams import Stream, generator
from lerobot_bomb.bomb.suite import Episode, Suite, Turn, draw_template, refuse_options

type Stones = Mapping[
    Intersection, str
]  # (row, column) -> colour of what stands on the board, as it was put there

INTERSECTIONS = tuple((row, column) for row in range(BOARD.num_lines) for column in range(BOARD.num_lines))
GRIPPER_START_SPREAD_M = 0.010  # of the gripper around the tray's centre, in x and in y
GRIPPER_START_HEIGHT_M = (0.08, 0.11)
# where the stones of the supply lie, from the tray's centre: fingers fit between two of them, and one that
# slips out of them to the right stays within reach
SUPPLY_XY_M = tuple((x, y) for y in (0.0690, 0.0230, -0.0230, -0.0690) for x in (-0.0310, 0.0160))
SUPPLY_SPREAD_M = 0.001
NUM_SUPPLY_BESIDE_PATTERN = 6  # of these places, those that leave room for the small board
# where the expert puts stones that it takes off the board
TRAY_XY_M = tuple((TRAY_CENTER_XY[0], y) for y in (0.0, 0.046, -0.046, 0.092, -0.092))
NUM_PARTS = 5  # one in so many of the arguments of a command is held out

TEMPLATES = ("{Command}.", "Please {command}.", "Your task: {command}.", "Now {command}.")
FORMS = (
    ("Could you {command}, please?", "I would like you to {command}."),
    ("What I want the arm to do is to {command}.", "The next thing to do: {command}."),
    (
        "Never mind what the table looks like, or how bright it is: {command}.",
        "There are 5 rows and 5 columns, and a tray beside them. {Command}.",
    ),
    (
        "Row 0 is the far row and column 0 the left one. {Command}.",
        "Seen from the near edge, with the tray on the right: {command}.",
    ),
    (
        "Leave everything that is not spoken of as it is, take all the time that you need, and, without "
        "touching more stones than you must, {command}.",
        "Of all that could be done on a Go board of 5 rows and 5 columns, one thing is asked for: {command}.",
    ),
)


@dataclass(frozen=True)
class TaskInstance:
    """Board, tray and command that are drawn for an episode of a task."""

    about: tuple[int, ...]  # the command's arguments, as numbers: colours, rows, directions
    stones: Stones  # on the board
    supply: tuple[str, ...] = ()  # colours of the stones in the tray, row by row from the far one
    pattern: Stones = field(default_factory=dict)  # on the small board

    def stone_on(self, intersection: Intersection) -> int:
        """Index of the stone on an intersection."""
        return len(self.supply) + list(self.stones).index(intersection)


@dataclass(frozen=True)
class Case:
    """Meaning of a command: its words, the moves that fulfil it, and the expert's aims."""

    commands: tuple[str, ...]  # one, or one for each move
    plans: tuple[Plan, ...]
    aims: tuple[Aim, ...]
    extra_colors: tuple[str, ...] = COLORS  # of stones that may join those on the board


class Task(ABC):
    """A verb, whose arguments are drawn for each episode."""

    @abstractmethod
    def draw(self, rng: np.random.Generator) -> TaskInstance:
        """Draw a board and the command's arguments; the command need not make sense on that board."""

    @abstractmethod
    def case(self, drawn: TaskInstance) -> Case | None:
        """Return what the command means on that board; None if it means nothing, or several things."""


def is_graspable(stones: Stones, intersection: Intersection) -> bool:
    """Return True if nothing stands left or right of an intersection, where the fingers go."""
    row, column = intersection
    return not {(row, column - 1), (row, column + 1)} & stones.keys()


def other_color(color: str) -> str:
    """Return white for black, and black for white."""
    return COLORS[1 - COLORS.index(color)]


def only(stones: Stones, color: str) -> Intersection | None:
    """Return the intersection of the only stone of a colour; None if there is none, or several."""
    intersections = [intersection for intersection, other in stones.items() if other == color]
    return intersections[0] if len(intersections) == 1 else None


def draw_intersections(
    rng: np.random.Generator, number: int, intersections: Sequence[Intersection] = INTERSECTIONS
) -> list[Intersection]:
    """Draw `number` different intersections."""
    return [intersections[i] for i in rng.choice(len(intersections), size=number, replace=False)]


def draw_stones(
    rng: np.random.Generator,
    number: int,
    intersections: Sequence[Intersection] = INTERSECTIONS,
    colors: Sequence[str] = COLORS,
) -> dict[Intersection, str]:
    """Draw `number` stones, each of one of these colours, on different intersections."""
    return {
        intersection: colors[int(rng.integers(len(colors)))]
        for intersection in draw_intersections(rng, number, intersections)
    }


def is_heldout(task_id: int, about: tuple[int, ...]) -> bool:
    """Return True if a command is held out; its verb and each of its arguments occur in others."""
    return (task_id + sum(place * number for place, number in zip(count(1), about))) % NUM_PARTS == 0


def command_suite(tasks: Sequence[Task], max_steps: int, num_goals: int, version: str) -> Suite:
    """Build a suite whose numbered tasks are verbs."""
    return Suite(
        partial(_sample, tasks),
        lambda spec: refuse_options(spec, "target", "color"),
        max_steps=max_steps,
        forms=FORMS,
        num_tasks=len(tasks),
        num_goals=num_goals,
        version=version,
    )


def draw_command(tasks: Sequence[Task], spec: EpisodeSpec) -> tuple[int, TaskInstance, Case]:
    """Draw a task's number and its board; return them with the meaning of its command."""
    drawn_id = int(generator(spec.seed, Stream.TARGET).integers(len(tasks)))
    task_id = drawn_id if spec.task_id is None else spec.task_id
    task, rng = tasks[task_id], generator(spec.seed, Stream.OPENING)
    while True:
        drawn = task.draw(rng)
        is_of_split = spec.split == "all" or is_heldout(task_id, drawn.about) == (spec.split == "heldout")
        case = task.case(drawn) if is_of_split and is_legal_position(drawn.stones) else None
        if case is not None:
            return task_id, drawn, case


def _sample(tasks: Sequence[Task], spec: EpisodeSpec) -> Episode:
    """Draw verb, board, command and start; the same spec gives the same episode."""
    refuse_options(spec, "target", "color")
    task_id, drawn, case = draw_command(tasks, spec)
    template = draw_template(spec, TEMPLATES)
    return Episode(
        spec=spec,
        task_id=task_id,
        turns=tuple(_turn(template, command) for command in case.commands),
        opening=drawn.stones,
        layout=put_on_board(drawn.stones, _layout(spec.seed, drawn)),
        supply=tuple(range(len(drawn.supply))),
        plans=case.plans,
        aims=case.aims,
        is_clear=partial(_means, tasks[task_id], drawn, case),
        extra_colors=case.extra_colors,
        pattern=drawn.pattern,
    )


def _turn(template: str, command: str) -> Turn:
    words = {"command": command, "Command": command[0].upper() + command[1:]}
    return Turn(template.format(**words), words)


def _means(task: Task, drawn: TaskInstance, case: Case, stones: Stones) -> bool:
    return task.case(replace(drawn, stones=stones)) == case


def _layout(seed: int, drawn: TaskInstance) -> Layout:
    """Draw the supply in the tray and the gripper above it; the board is empty."""
    gripper, supply = generator(seed, Stream.GRIPPER), generator(seed, Stream.SUPPLY)
    gripper_xyz = np.array([*TRAY_CENTER_XY, gripper.uniform(*GRIPPER_START_HEIGHT_M)])
    gripper_xyz[:2] += gripper.uniform(-GRIPPER_START_SPREAD_M, GRIPPER_START_SPREAD_M, 2)
    number = len(drawn.supply)
    places = np.array(SUPPLY_XY_M[:NUM_SUPPLY_BESIDE_PATTERN] if drawn.pattern else SUPPLY_XY_M)
    stone_xy = np.zeros((NUM_STONES, 2))
    stone_xy[:number] = TRAY_CENTER_XY + places[np.sort(supply.permutation(len(places))[:number])]
    stone_xy[:number] += supply.uniform(-SUPPLY_SPREAD_M, SUPPLY_SPREAD_M, (number, 2))
    is_white = np.array([color == "white" for color in drawn.supply] + [False] * (NUM_STONES - number))
    return Layout(gripper_xyz, stone_xy, is_white, np.arange(NUM_STONES) < number)
