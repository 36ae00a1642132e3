"""The expert's next action is a function of what is seen and said: a reader of both alone finds the same.

The reader gets the stones in a drawn order, without their numbers, and no history; what an expert knows that
the reader cannot find, no policy without memory can learn.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest

from lerobot_bomb.bomb.board import BOARD, COLORS, NUM_STONES, TRAY_CENTER_XY, TRAY_HALF_SIZE_XY, Intersection
from lerobot_bomb.bomb.commands import INTERSECTIONS, SUPPLY_XY_M, TRAY_XY_M
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.expert import OFF_BESIDE_M, REACHED_HEIGHT_M, REACHED_LATERAL_M, expert_action
from lerobot_bomb.bomb.go import group_of, liberties_of
from lerobot_bomb.bomb.move import Aim
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.bomb.privileged_state import Goal, PrivilegedState
from lerobot_bomb.bomb.streams import recorder_noise
from lerobot_bomb.bomb.suite import find_suite
from lerobot_bomb.bomb.suites import SUITES
from lerobot_bomb.envs.rollout import Moment, add_noise, expert_agent, run_episode
from lerobot_env_bomb.bomb.env import BombEnv

SUCCESSES, COMPARED = 0.9, 0.98  # least shares of episodes and of steps
NOISE = 0.05  # on what is executed, as in recordings
SMALL = RenderOptions(image_size=32)
NEAR_M = 0.012  # of the gripper, for a stone between its pads; of a place, for one that lies there
BOARD_END_M = TRAY_CENTER_XY[0] - TRAY_HALF_SIZE_XY[0]  # x at which the tray begins
TRAY_ROW_M = SUPPLY_XY_M[0][1] - SUPPLY_XY_M[2][1]
FLAT_M = REACHED_HEIGHT_M[0]  # of its height at rest, for a stone that lies
LEANS_M = BOARD.stone_height_m  # the same in the tray, where one stone may lean on another
HELD_OPENING_M = (0.012, 0.030)  # between pads that hold a stone
REST_M = BOARD.thickness_m + BOARD.stone_height_m / 2
LEFT_SIDE = [intersection for intersection in INTERSECTIONS if intersection[1] < 2]
type Place = tuple[float, float]  # metres


@dataclass
class View:
    """View of all that can be seen."""

    text: str  # what is said
    state: PrivilegedState  # its stones in a drawn order, its goals none
    pattern: dict[Intersection, str]  # on the small board

    def __post_init__(self) -> None:
        self.held: int | None = None
        self.on_board: dict[Intersection, int] = {}
        self.in_tray: list[int] = []  # row by row
        self.lying: list[int] = []  # on the board or in the tray
        for stone in np.flatnonzero(self.state.stone_in_play).tolist():
            x, y, _ = self.xyz(stone)
            if self._is_held(stone):
                self.held = stone
                continue
            self.lying.append(stone)
            if x < BOARD_END_M:
                # one that slips out of the fingers is off it for a moment
                self.on_board[BOARD.nearest_intersection(np.array([x, y]))] = stone
            else:
                self.in_tray.append(stone)
        self.in_tray.sort(key=lambda stone: (-(self.xyz(stone)[1] // TRAY_ROW_M), self.xyz(stone)[0]))

    def xyz(self, stone: int) -> np.ndarray:
        return self.state.stone_xyz[stone]

    def color(self, stone: int | None) -> str | None:
        return None if stone is None else COLORS[int(self.state.stone_is_white[stone])]

    def at(self, intersection: Intersection) -> str | None:
        return self.color(self.on_board.get(intersection))

    def intersections(self, color: str) -> list[Intersection]:
        return sorted(intersection for intersection in self.on_board if self.at(intersection) == color)

    def first_in_tray(self, color: str) -> int:
        return next(stone for stone in self.in_tray if self.color(stone) == color)

    @property
    def next_tray_place(self) -> Place:
        """The first of the expert's places that is free."""
        taken = [self.xyz(stone)[:2] for stone in self.in_tray]
        return next(place for place in TRAY_XY_M if all(np.hypot(*(xy - place)) > NEAR_M for xy in taken))

    @property
    def is_settled(self) -> bool:
        """Tell whether nothing flies or leans on the board, where a stone may have slipped or been hit.

        No two stones lie nearest to one intersection, either. In the tray they may lean on each other.
        """
        is_alone = len(self.lying) == len(self.on_board) + len(self.in_tray)
        is_flat = all(self._off_rest_m(stone) < FLAT_M for stone in self.on_board.values())
        return is_alone and is_flat and all(self._off_rest_m(stone) < LEANS_M for stone in self.in_tray)

    def _off_rest_m(self, stone: int) -> float:
        return abs(float(self.xyz(stone)[2]) - REST_M)

    def _is_held(self, stone: int) -> bool:
        offset = self.xyz(stone) - self.state.gripper_xyz
        is_between = np.hypot(*offset[:2]) < NEAR_M and -0.004 < offset[2] < 0.03
        return bool(is_between and HELD_OPENING_M[0] < self.state.finger_opening < HELD_OPENING_M[1])


type Next = tuple[int, Place] | None  # the stone that is to be moved and where to; None: all is done


def place_of(intersection: Intersection) -> Place:
    x, y = BOARD.intersection_xy(*intersection)
    return float(x), float(y)


def intersections_in(text: str) -> list[Intersection]:
    return [(int(r), int(c)) for r, c in re.findall(r"(?:row |\()(\d),(?: column)? (\d)", text)]


def next_move(text: str, view: View) -> Next:
    """Return the next move of someone who reads an unperturbed instruction."""
    if re.search(r"clear row|off the board|take back", text):
        return next_removal(text, view)
    if found := re.search(r"capture the (?:\d )?(\w+) stones?.*: play (\w+)", text):
        return next_of_capture(found[1], found[2], view)
    if found := re.search(r"swap the (\w+) stone .* the (\w+) stone", text):
        return next_of_swap((found[1], found[2]), intersections_in(text), view)
    if found := re.search(r"push the (\w+) stone", text):
        held = [] if view.held is None else [view.held]
        (stone,) = [stone for stone in [*held, *view.on_board.values()] if view.color(stone) == found[1]]
        return stone, place_of(intersections_in(text)[0])
    if found := re.search(r"bring all (\w+) stones to the left side", text):
        place = next((intersection for intersection in LEFT_SIDE if intersection not in view.on_board), None)
        left = [intersection for intersection in view.intersections(found[1]) if intersection[1] > 1]
        if view.held is None and not left:
            return None
        assert place is not None
        return view.on_board[left[0]] if view.held is None else view.held, place_of(place)
    return next_from_tray(text, view)


def next_from_tray(text: str, view: View) -> Next:
    if moves := re.findall(r"(black|white) at row (\d), column (\d)", text):
        return next_of_moves([(color, (int(r), int(c))) for color, r, c in moves], view)
    if "copy the pattern" in text:
        return next_of_moves(
            [(color, intersection) for intersection, color in sorted(view.pattern.items())], view
        )
    if found := re.search(r"free intersections of row (\d).*(black|white) last", text):
        free = [
            intersection
            for intersection in INTERSECTIONS
            if intersection[0] == int(found[1]) and intersection not in view.on_board
        ]
        color = COLORS[(COLORS.index(found[2]) + len(free) - 1) % 2]
        return next_of_moves([(color, intersection) for intersection in free[:1]], view)
    place = next(iter(intersections_in(text)), None) or named_place(text, view)
    if place is None or place in view.on_board:
        return None
    return named_stone(text, view) if view.held is None else view.held, place_of(place)


def next_of_moves(moves: list[tuple[str, Intersection]], view: View) -> Next:
    for color, intersection in moves:
        if view.at(intersection) != color:
            return view.first_in_tray(color) if view.held is None else view.held, place_of(intersection)
    return None


def next_removal(text: str, view: View) -> Next:
    if found := re.search(r"clear row (\d)", text):
        left = sorted(intersection for intersection in view.on_board if intersection[0] == int(found[1]))
    elif found := re.search(r"take the (black|white) stone", text):
        left = view.intersections(found[1])
    else:
        left = [
            intersection for intersection in reversed(intersections_in(text)) if intersection in view.on_board
        ]
    if view.held is None and not left:
        return None
    return view.held if view.held is not None else view.on_board[left[0]], view.next_tray_place


def next_of_capture(color: str, by: str, view: View) -> Next:
    """`by` takes the last liberty, then what has none is taken off."""
    board = {
        intersection: COLORS[int(view.state.stone_is_white[stone])]
        for intersection, stone in view.on_board.items()
    }
    groups = {
        frozenset(group_of(board, intersection)): min(group_of(board, intersection))
        for intersection in view.intersections(color)
    }
    liberties = {group: liberties_of(board, intersection) for group, intersection in groups.items()}
    if view.color(view.held) == by or any(view.color(stone) == by for stone in view.in_tray):
        (liberty,) = next(places for places in liberties.values() if len(places) == 1)
        return view.first_in_tray(by) if view.held is None else view.held, place_of(liberty)
    if view.held is not None:
        return view.held, view.next_tray_place
    # of two, the other one has the first's intersection for a liberty, and the first lies in the tray
    taken = sorted(
        intersection for group, places in liberties.items() if not places for intersection in group
    )
    if not taken and len(view.in_tray) == 1 and "2 " in view.text:
        taken = sorted(min(group) for group, places in liberties.items() if len(places) == 1)
    return (view.on_board[taken[0]], view.next_tray_place) if taken else None


def next_of_swap(colors: tuple[str, str], intersections: list[Intersection], view: View) -> Next:
    (first, second), (a, b) = colors, intersections
    if view.at(a) == second:  # the first goes where the second stood
        if view.at(b) == first:
            return None
        return view.in_tray[0] if view.held is None else view.held, place_of(b)
    if view.in_tray:
        return view.on_board[b] if view.held is None else view.held, place_of(a)
    return view.on_board[a] if view.held is None else view.held, TRAY_XY_M[0]


def named_stone(text: str, view: View) -> int:
    """Return the stone in the tray that the instruction names."""
    xy = {stone: view.xyz(stone)[:2] for stone in view.in_tray}
    if "nearest to the gripper" in text:
        return min(xy, key=lambda stone: float(np.hypot(*(xy[stone] - view.state.gripper_xyz[:2]))))
    if found := re.search(r"(nearest to|farthest from) the (\w+) stone", text):
        anchor = view.first_in_tray(found[2])
        sign = 1 if found[1] == "nearest to" else -1
        others = [stone for stone in xy if stone != anchor]
        return min(others, key=lambda stone: sign * float(np.hypot(*(xy[stone] - xy[anchor]))))
    if found := re.search(r"(left|right|front)most", text):
        axis, sign = {"left": (0, 1), "right": (0, -1), "front": (1, 1)}[found[1]]
        return min(xy, key=lambda stone: sign * xy[stone][axis])
    found = re.search(r"(black|white) (?:stone|piece)", text)
    assert found
    return view.first_in_tray(found[1])


def named_place(text: str, view: View) -> Intersection | None:
    if found := re.search(r"(left of|right of|behind|in front of|between) the (?:two )?(\w+) stone", text):
        anchors = view.intersections(found[2])
        if found[1] == "between":
            (r1, c1), (r2, c2) = anchors
            return (r1 + r2) // 2, (c1 + c2) // 2
        (row, column) = anchors[0]
        rows, columns = {"left of": (0, -1), "right of": (0, 1), "behind": (-1, 0), "in front of": (1, 0)}[
            found[1]
        ]
        return row + rows, column + columns
    if found := re.search(r"(far|near) (left|right) corner", text):
        return {"far": 0, "near": 4}[found[1]], {"left": 0, "right": 4}[found[2]]
    if re.search(r"in the centre|star point", text):
        return 2, 2
    rows = [[(row, c) for c in range(5) if (row, c) not in view.on_board] for row in range(5)]
    return next((free[0] for free in rows if len(free) == 1), None)


def goals_of_reader(view: View) -> tuple[Goal, ...]:
    """The next move, after the stone that the fingers may just have put down."""
    following = next_move(view.text, view)
    stone = None if following is None else following[0]
    away_m = {
        other: float(np.linalg.norm((view.xyz(other) - view.state.gripper_xyz)[:2]))
        for other in view.lying
        if other != stone
    }
    before = min(away_m, key=away_m.__getitem__, default=None)
    goals = []
    if before is not None:
        # a neighbour that the fingers are not over, or that lies where none is put, was not just put down
        place = put_down_on(view.xyz(before)[:2])
        is_over = view.held is None and away_m[before] <= OFF_BESIDE_M[0]
        if following is None:
            goals.append((before, place or tuple(view.xyz(before)[:2])))
        elif place is not None and is_over:
            goals.append((before, place))
    if following is not None:
        goals.append(following)
    return tuple(Goal(np.array([*place, REST_M]), stone, "push" in view.text) for stone, place in goals)


def put_down_on(xy: np.ndarray) -> Place | None:
    """Return the intersection, or the place in the tray, that a stone was put down on."""
    places = [*map(place_of, INTERSECTIONS), *TRAY_XY_M]
    return next((place for place in places if np.hypot(*(xy - place)) < REACHED_LATERAL_M[1]), None)


def seen(moment: Moment, pattern: dict[Intersection, str], rng: np.random.Generator) -> View:
    state = moment.state
    order = rng.permutation(NUM_STONES)
    return View(
        moment.instruction.lower(),
        replace(
            state,
            goals=(),
            stone_xyz=state.stone_xyz[order],
            stone_is_white=state.stone_is_white[order],
            stone_in_play=state.stone_in_play[order],
        ),
        pattern,
    )


def has_fallen(state: PrivilegedState, start: PrivilegedState, aims: Sequence[Aim]) -> bool:
    """Tell whether a stone slipped or was hit and lies on the board where nobody put it.

    Whoever has not seen it fall cannot know that it is the one to go on with.
    """
    if any(aim.is_slid for aim in aims):
        return False  # a stone that is pushed lies on its way
    for stone in np.flatnonzero(state.stone_in_play).tolist():
        xy, z = state.stone_xyz[stone, :2], state.stone_xyz[stone, 2]
        places = [start.stone_xyz[stone, :2], *(np.array(aim.xy) for aim in aims if aim.stone == stone)]
        lies_on_board = xy[0] < BOARD_END_M and abs(z - REST_M) < FLAT_M
        if lies_on_board and all(np.hypot(*(xy - place)) > NEAR_M for place in places):
            return True
    return False


class UndrawnEnv(BombEnv):
    """Environment without images, which the reader does not need."""

    def _view(self, camera: str) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        return np.zeros((SMALL.image_size, SMALL.image_size, 3), np.uint8), {}


@dataclass
class Reading:
    """An episode of the expert, under noise, and the steps in which the reader acts otherwise."""

    otherwise: list[str]
    num_steps: int = 0
    num_compared: int = 0
    is_success: bool = False


def run_and_read(env: BombEnv, spec: EpisodeSpec) -> Reading:
    rng, noise = np.random.default_rng(spec.seed), recorder_noise(spec.seed)
    reading = Reading([])
    episode = find_suite(spec.suite).sample(spec)
    pattern = dict(episode.pattern)
    start = None
    for moment in run_episode(env, spec, expert_agent(), lambda a: add_noise(a, NOISE, "relative", noise)):
        reading.is_success = moment.info["is_success"]
        if moment.action is None:
            continue
        start = start or moment.state
        view = seen(moment, pattern, rng)
        reading.num_steps += 1
        if not view.is_settled or has_fallen(moment.state, start, episode.aims):
            continue
        reading.num_compared += 1
        action = expert_action(replace(view.state, goals=goals_of_reader(view)))
        if abs(action - expert_action(moment.state)).max() > 0.02:
            step = f"{spec.suite} seed {spec.seed} step {moment.step}"
            reading.otherwise.append(f"{step}: {moment.instruction}")
    return reading


def check(suite: str, task_id: int | None, seeds: Sequence[int]) -> None:
    """The reader acts as the expert does in every step of these episodes, which nearly all end in success."""
    env = UndrawnEnv(EpisodeSpec(0, suite, task_id=task_id), SMALL)
    reading = [run_and_read(env, EpisodeSpec(seed, suite, task_id=task_id)) for seed in seeds]
    assert [text for each in reading for text in each.otherwise] == []
    assert sum(each.num_compared for each in reading) >= COMPARED * sum(each.num_steps for each in reading)
    assert sum(each.is_success for each in reading) >= SUCCESSES * len(reading)


TASKS = [
    (suite, task_id)
    for suite in SUITES
    # a task of `place` is an intersection and a colour, of which each episode draws one
    for task_id in ([None] if suite == "place" else range(find_suite(suite).num_tasks))
]


@pytest.mark.parametrize(("suite", "task_id"), TASKS)
def test_the_next_action_is_seen_and_said(suite: str, task_id: int | None) -> None:
    check(suite, task_id, [7])


@pytest.mark.long
@pytest.mark.parametrize(("suite", "task_id"), TASKS)
def test_the_next_action_is_seen_and_said_in_200_episodes(suite: str, task_id: int | None) -> None:
    check(suite, task_id, range(200))
