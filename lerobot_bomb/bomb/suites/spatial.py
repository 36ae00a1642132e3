"""Suite `spatial`: one stone, whose place is named by the board or its stones, not by numbers."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, partial

import numpy as np

from lerobot_bomb.bomb.board import BOARD, COLORS, Intersection
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.go import is_legal_move, is_legal_position
from lerobot_bomb.bomb.layout import put_on_board
from lerobot_bomb.bomb.move import aim_at, one_move
from lerobot_bomb.bomb.streams import Stream, generator
from lerobot_bomb.bomb.suite import Episode, Suite, Turn, draw_template, of_split, refuse_options
from lerobot_bomb.bomb.suites.place import ALL_TARGETS, STONE, layout_of_one

MAX_OPENING_STONES = 8
LAST = BOARD.num_lines - 1
MIDDLE = LAST // 2

type Stones = Mapping[Intersection, str]  # (row, column) -> colour of what stands on the board

TEMPLATES = (
    "Place a {color} stone {place}.",
    "Put a {color} stone {place} on the Go board.",
    "Move the {color} stone from the tray so that it lies {place}.",
    "Set a {color} stone {place}.",
)
FORMS = (
    (
        "Please place a {color} stone {place} on the board.",
        "Take a {color} stone and put it {place}.",
    ),
    (
        "A {color} stone is needed {place}.",
        "Grab the {color} piece from the tray and leave it {place}.",
    ),
    (
        "Not at row {other_row}, column {other_column}: place a {color} stone {place}.",
        "There are 5 rows and 5 columns. Place a {color} stone {place}.",
    ),
    (
        "Seen from the near edge, with the tray on the right: place a {color} stone {place}.",
        "The left column is column 0, the far row is row 0. Put a {color} piece {place}.",
    ),
    (
        "Leave {other_letter}{other_near_row_from_1} alone, whichever point that may be, and see to it that "
        "in the end a {color} piece rests {place}.",
        "Of all free intersections one is meant, the one {place}: that is where a {color} piece belongs.",
    ),
)


class PlaceTask(ABC):
    """Task whose instruction describes a place by the stones that stand there."""

    place: str  # how the instruction names it; {anchor} is the colour of the stones that it refers to
    has_anchor = True

    @abstractmethod
    def select(self, stones: Stones, anchor: str) -> Intersection | None:
        """Return the place that is meant; None if none or several fit, or if it is taken."""

    @abstractmethod
    def referents(self, target: Intersection) -> list[list[Intersection]]:
        """Return each arrangement of stones in which `target` is meant; empty if there is none."""

    @property
    def targets(self) -> tuple[Intersection, ...]:
        """Intersections that can be meant."""
        return tuple(intersection for intersection in ALL_TARGETS if self.referents(intersection))


@dataclass(frozen=True)
class Beside(PlaceTask):
    """Task: the place some rows and columns from the only stone of the anchor's colour."""

    place: str
    rows: int
    columns: int

    def select(self, stones: Stones, anchor: str) -> Intersection | None:
        anchors = [intersection for intersection, color in stones.items() if color == anchor]
        if len(anchors) != 1:
            return None
        place = anchors[0][0] + self.rows, anchors[0][1] + self.columns
        return place if place in ALL_TARGETS and place not in stones else None

    def referents(self, target: Intersection) -> list[list[Intersection]]:
        intersection = target[0] - self.rows, target[1] - self.columns
        return [[intersection]] if intersection in ALL_TARGETS else []


@dataclass(frozen=True)
class Between(PlaceTask):
    """Task: the place halfway between the only two stones of the anchor's colour, in their row or column."""

    place: str

    def select(self, stones: Stones, anchor: str) -> Intersection | None:
        anchors = [intersection for intersection, color in stones.items() if color == anchor]
        places = [
            intersection
            for intersection in ALL_TARGETS
            if sorted(anchors) in map(sorted, self.referents(intersection))
        ]
        return places[0] if places and places[0] not in stones else None

    def referents(self, target: Intersection) -> list[list[Intersection]]:
        row, column = target
        pairs = [[(row, column - 1), (row, column + 1)], [(row - 1, column), (row + 1, column)]]
        return [pair for pair in pairs if set(pair) <= set(ALL_TARGETS)]


@dataclass(frozen=True)
class Fixed(PlaceTask):
    """Task: a fixed place of the board."""

    place: str
    intersection: Intersection
    has_anchor = False

    def select(self, stones: Stones, anchor: str) -> Intersection | None:
        return None if self.intersection in stones else self.intersection

    def referents(self, target: Intersection) -> list[list[Intersection]]:
        return [[]] if target == self.intersection else []


@dataclass(frozen=True)
class Gap(PlaceTask):
    """Task: the only free intersection of a row; every other row has none or several."""

    place: str
    has_anchor = False

    def select(self, stones: Stones, anchor: str) -> Intersection | None:
        rows = [[(row, column) for column in range(BOARD.num_lines)] for row in range(BOARD.num_lines)]
        gaps = [
            left
            for row in rows
            if len(left := [intersection for intersection in row if intersection not in stones]) == 1
        ]
        return gaps[0][0] if len(gaps) == 1 else None

    def referents(self, target: Intersection) -> list[list[Intersection]]:
        row, column = target
        return [[(row, other) for other in range(BOARD.num_lines) if other != column]]


TASKS: tuple[PlaceTask, ...] = (
    Beside("to the left of the {anchor} stone", rows=0, columns=-1),
    Beside("to the right of the {anchor} stone", rows=0, columns=1),
    Beside("behind the {anchor} stone", rows=-1, columns=0),
    Beside("in front of the {anchor} stone", rows=1, columns=0),
    Between("between the two {anchor} stones"),
    Fixed("in the centre", (MIDDLE, MIDDLE)),
    Fixed("in the far left corner", (0, 0)),
    Fixed("in the far right corner", (0, LAST)),
    Fixed("in the near left corner", (LAST, 0)),
    Fixed("in the near right corner", (LAST, LAST)),
    Fixed("on the star point", (MIDDLE, MIDDLE)),
    Gap("on the only free intersection of a row"),
)
NUM_PARTS = 5  # one in so many cases is held out


def _is_heldout(task_id: int, target: Intersection, color: str) -> bool:
    """Return True if a case is held out: every relation, place and colour is seen in other cases."""
    if len(TASKS[task_id].targets) == 1:
        return (task_id + 3 * COLORS.index(color)) % (NUM_PARTS + 1) == NUM_PARTS
    return (task_id + target[0] + 2 * target[1]) % NUM_PARTS == 0


@cache
def cases_of_split(split: str) -> tuple[tuple[int, Intersection, str], ...]:
    """Return the cases (task, target, colour of the stone to be moved) that a split draws from."""
    cases = [
        (task_id, target, color)
        for task_id in range(len(TASKS))
        for target in TASKS[task_id].targets
        for color in COLORS
    ]
    return of_split(split, cases, [case for case in cases if _is_heldout(*case)])


def _cases(spec: EpisodeSpec) -> dict[int, list[tuple[Intersection, str]]]:
    """Return the cases {task: targets and colours} that a spec draws from."""
    cases: dict[int, list[tuple[Intersection, str]]] = {}
    for task_id, target, color in cases_of_split(spec.split):
        if spec.task_id in (None, task_id) and spec.color in (None, color):
            cases.setdefault(task_id, []).append((target, color))
    return cases


def _check(spec: EpisodeSpec) -> None:
    """Raise a ValueError that names the flag unless the spec has an episode."""
    refuse_options(spec, "target")
    if not _cases(spec):
        raise ValueError(
            f"--env.split={spec.split} has no task {spec.task_id} with --env.color={spec.color}; "
            "leave out one of them"
        )


def _sample_episode(spec: EpisodeSpec) -> Episode:
    """Draw task, target, colour, opening and start; the same spec gives the same episode."""
    _check(spec)
    cases = _cases(spec)
    rng = generator(spec.seed, Stream.TARGET)
    task_id = list(cases)[rng.integers(len(cases))]  # first the task, so that each is as frequent
    target, color = cases[task_id][rng.integers(len(cases[task_id]))]
    task, anchor = TASKS[task_id], COLORS[1 - COLORS.index(color)]
    extra_colors = (color,) if task.has_anchor else COLORS
    opening = _sample_opening(generator(spec.seed, Stream.OPENING), task, target, color, anchor, extra_colors)
    words = {"color": color, "place": task.place.format(anchor=anchor)}
    template = draw_template(spec, TEMPLATES)
    return Episode(
        spec=spec,
        task_id=task_id,
        turns=(Turn(template.format(**words), words),),
        opening=opening,
        layout=put_on_board(opening, layout_of_one(spec.seed, color)),
        supply=(STONE,),
        plans=((one_move(STONE, [target]),),),
        aims=(aim_at(STONE, target),),
        target=target,
        color=color,
        is_clear=partial(_means, task, anchor, target),
        extra_colors=extra_colors,
    )


def _means(task: PlaceTask, anchor: str, target: Intersection, stones: Stones) -> bool:
    return task.select(stones, anchor) == target


def _sample_opening(
    rng: np.random.Generator,
    task: PlaceTask,
    target: Intersection,
    color: str,
    anchor: str,
    extra_colors: tuple[str, ...],
) -> dict[Intersection, str]:
    """Draw up to 8 stones with which the move is legal and the instruction clear."""
    while True:
        ways = task.referents(target)
        intersections = ways[rng.integers(len(ways))]
        # stones of a row that is filled are of both colours
        colors = (
            [anchor] * len(intersections)
            if task.has_anchor
            else [COLORS[i] for i in rng.integers(2, size=len(intersections))]
        )
        opening = dict(zip(intersections, colors, strict=True))
        free = [
            intersection
            for intersection in ALL_TARGETS
            if intersection not in opening and intersection != target
        ]
        num_others = rng.integers(MAX_OPENING_STONES - len(opening) + 1)
        first = rng.integers(len(extra_colors))
        for i, k in enumerate(rng.permutation(len(free))[:num_others]):
            opening[free[k]] = extra_colors[(first + i) % len(extra_colors)]
        if (
            is_legal_position(opening)
            and is_legal_move(opening, target, color)
            and _means(task, anchor, target, opening)
        ):
            return opening


SUITE = Suite(_sample_episode, _check, max_steps=100, forms=FORMS, num_tasks=len(TASKS))
