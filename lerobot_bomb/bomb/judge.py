"""Judge of an episode: follows the moves of its plans, and says how it ended."""

import math
from collections.abc import Iterator

import numpy as np

from lerobot_bomb.bomb.board import BOARD, NUM_STONES
from lerobot_bomb.bomb.episode import COLLATERAL_TOLERANCE_MM, DROP_HEIGHT_M, OFF_BOARD_M, Failure, Stage
from lerobot_bomb.bomb.goals import Course, course_goals
from lerobot_bomb.bomb.layout import SceneState
from lerobot_bomb.bomb.move import (
    TRAY,
    Made,
    Move,
    Place,
    Plan,
    distance_m,
    open_moves,
    places_left,
    stones_left,
)
from lerobot_bomb.bomb.privileged_state import Goal
from lerobot_bomb.bomb.suite import Episode, find_suite

REST_S = 0.5  # a stone that was carried and then rests this long has been put down
REST_SPEED_M_S = 0.005  # below it a stone rests
LIFT_M = 0.010  # above its resting height a held stone counts as lifted
FLAT_TOLERANCE_M = 0.003  # of the height at rest; a stone that leans or lies on another one is higher
V0_TOLERANCE_MM = 26.0  # of the original benchmark's rule


class Judge:
    """State of one episode, updated with a snapshot after every control step.

    A stone that was carried is put down once it is no longer touched and has been at rest for `REST_S`. Then
    it must lie flat at a place of an open move: on an intersection within the spec's tolerance, or
    anywhere in the tray. Plans without such a move are given up; the episode fails when none is left.

    Success: all moves of a plan have been made, and no stone but those of open moves was moved by more than
    10 mm from where it stood or was put down.
    """

    def __init__(self, episode: Episode, fps: int, start: SceneState, made: Made):
        """Judge an episode from its start.

        Args:
            episode: what is asked for.
            fps: updates per second.
            start: snapshot at the start.
            made: moves of the first plan that the start shows as made.
        """
        self.stage = Stage.START
        self.failure: Failure | None = None
        self.is_success = False
        self.is_success_bomb_v0 = False
        self.collateral_mm = 0.0
        self._episode = episode
        self._fps = fps
        plans = episode.plans[:1] if made else episode.plans
        self._plans: list[tuple[Plan, Made]] = [(plan, made) for plan in plans]
        self._is_complete = False  # the last move has been made, which the plans still lack
        self._movable = self._find_movable()
        self._stone = episode.aims[len(made)].stone  # the one that is moved, or is to be moved next
        self._left_xyz = start.stone_xyz.copy()  # where each stone stood or was put down
        self._now = start
        self._was_lifted: np.ndarray = np.zeros(NUM_STONES, dtype=bool)
        self._last_touched_z = start.stone_xyz[:, 2].copy()
        self._rest_steps = np.zeros(NUM_STONES, dtype=int)

    @property
    def num_made(self) -> int:
        """Number of moves that have been made."""
        return max(len(made) for _, made in self._plans) + self._is_complete

    @property
    def progress(self) -> float:
        """Share of the moves that have been made."""
        return self.num_made / len(self._plans[0][0])

    @property
    def placement_error_mm(self) -> float:
        """Horizontal distance of the stone that is moved from the nearest of its places."""
        return 1e3 * min(distance_m(self._now.stone_xyz[self._stone, :2], place) for place in self._places())

    @property
    def nearest_intersection(self) -> tuple[int, int]:
        """(row, column) of the intersection nearest to the stone that is moved."""
        return BOARD.nearest_intersection(self._now.stone_xyz[self._stone, :2])

    def goals(self) -> tuple[Goal, ...]:
        """Return the expert's goals, as far as instructions have named them: those reached, then the others.

        There are always `Suite.num_goals`: the last one is repeated if need be.
        """
        goals = tuple(goal for _, goal in self._goals_of(self._furthest_course()))
        return goals + goals[-1:] * (find_suite(self._episode.spec.suite).num_goals - len(goals))

    def next_goal(self) -> Goal:
        """Return the goal of the first move that has not been made; the last one if all have been."""
        course = self._furthest_course()
        goals = list(self._goals_of(course))
        return next((goal for number, goal in goals if number not in course.made), goals[-1][1])

    def update(self, now: SceneState) -> bool:
        """Update with the state after a control step; return True if the episode has ended."""
        touched = now.stone_touched[:, 0] | now.stone_touched[:, 1]
        held = now.stone_touched[:, 0] & now.stone_touched[:, 1]
        step_m = now.stone_xyz - self._now.stone_xyz
        speed_m_s = np.sqrt((step_m**2).sum(axis=1)) * self._fps
        self._rest_steps = np.where(~touched & (speed_m_s < REST_SPEED_M_S), self._rest_steps + 1, 0)
        is_high: np.ndarray = now.stone_xyz[:, 2] > self._episode.layout.rest_height_m + LIFT_M
        self._was_lifted = self._was_lifted | (held & is_high)
        self._last_touched_z[touched] = now.stone_xyz[touched, 2]
        self._now = now
        self._follow(touched, held)
        moved_mm = 1e3 * np.linalg.norm(now.stone_xyz - self._left_xyz, axis=1)
        others_mm = np.delete(moved_mm, list(self._movable))
        self.collateral_mm = max(self.collateral_mm, float(others_mm.max(initial=0.0)))
        self._update_stage(bool(held[self._stone]))

        carried = self._was_lifted.copy()
        # a stone that was pushed, not carried, to its place lies there all the same
        for stone in self._movable:
            carried[stone] |= self._is_flat(stone) and bool(self._fitting(stone))
        ended = carried & (self._rest_steps >= math.ceil(REST_S * self._fps))
        for stone in sorted(self._movable):
            if ended[stone]:
                return self._judge_placement(stone)
        if ended.any():
            self.failure = Failure.WRONG_STONE
        return bool(ended.any())

    def time_out(self) -> None:
        """Set `failure` of an episode that has run out of time."""
        touched = self._now.stone_touched[self._stone]
        was_lifted = bool(self._was_lifted[self._stone])
        if self._was_lifted.any() and not was_lifted:
            self.failure = Failure.WRONG_STONE
        elif self.stage is Stage.START:
            self.failure = Failure.NEVER_REACHED
        elif touched.all() or (was_lifted and (touched.any() or self._is_at_place(self._stone))):
            self.failure = Failure.TIMEOUT_HOLDING
        else:
            self.failure = Failure.DROPPED if was_lifted else Failure.MISSED_GRASP

    def _goals_of(self, course: Course) -> Iterator[tuple[int, Goal]]:
        return course_goals(course, self._episode.layout, self._now.stone_xyz)

    def _furthest_course(self) -> Course:
        """Return the course of the plan that has come furthest, as far as instructions have named it."""
        by_turns = len(self._episode.turns) > 1
        courses = [
            self._course(plan[: len(made) + 1] if by_turns else plan, made) for plan, made in self._plans
        ]
        return max(courses, key=lambda each: (len(each.lying), each.carried is not None))

    def _course(self, plan: Plan, made: Made) -> Course:
        """Return how far a plan has come, by what lies in place and what the fingers carry."""
        held, lying = set(np.flatnonzero(self._now.stone_touched.all(axis=1)).tolist()), dict(made)
        for number, move in open_moves(plan, lying):  # a move that lies in place opens later ones
            in_place = (
                (stone, place)
                for stone in sorted(stones_left(move, lying))
                if self._is_flat(stone) and stone not in held
                for place in self._places_under(stone, move, lying)
            )
            if (found := next(in_place, None)) is not None:
                lying[number] = found
        carried = (
            (number, stone)
            for number, move in open_moves(plan, lying)
            for stone in sorted(stones_left(move, lying))
            if stone in held or self._was_lifted[stone]
        )
        return Course(plan, made, lying, next(carried, None))

    def _find_movable(self) -> set[int]:
        """Return the stones of open moves."""
        return {
            stone
            for plan, made in self._plans
            for _, move in open_moves(plan, made)
            for stone in stones_left(move, made)
        }

    def _places(self) -> set[Place]:
        """Return the places to which the followed stone may come."""
        return {
            place
            for plan, made in self._plans
            for _, move in open_moves(plan, made)
            if self._stone in stones_left(move, made)
            for place in places_left(move, made)
        }

    def _follow(self, touched: np.ndarray, held: np.ndarray) -> None:
        """Switch to the stone that is held or touched, where several may be moved."""
        if len(self._movable) > 1:
            gripped = sorted(self._movable, key=lambda stone: (not held[stone], not touched[stone]))
            if touched[gripped[0]] and not touched[self._stone]:
                self._stone = gripped[0]

    def _update_stage(self, is_held: bool) -> None:
        offset = self._now.gripper_xyz - self._now.stone_xyz[self._stone]
        layout = self._episode.layout
        is_beside = np.linalg.norm(offset[:2]) < layout.stone_radius_m
        is_around = is_beside and offset[2] < layout.stone_height_m / 2
        reached = {
            Stage.REACHED: is_around,
            Stage.GRASPED: is_held,
            Stage.LIFTED: self._was_lifted[self._stone],
        }
        order = list(Stage)
        for stage, is_reached in reached.items():
            if is_reached and order.index(stage) > order.index(self.stage):
                self.stage = stage

    def _is_flat(self, stone: int) -> bool:
        height_m = self._now.stone_xyz[stone, 2] - self._episode.layout.rest_height_m
        return bool(abs(height_m) < FLAT_TOLERANCE_M)

    def _is_at(self, stone: int, place: Place) -> bool:
        tolerance_mm = 0.0 if place == TRAY else self._episode.spec.success_tolerance_mm
        return 1e3 * distance_m(self._now.stone_xyz[stone, :2], place) <= tolerance_mm

    def _is_at_place(self, stone: int) -> bool:
        return self._is_flat(stone) and bool(self._fitting(stone))

    def _fitting(self, stone: int) -> list[tuple[Plan, Made]]:
        """Return the plans that have a move for this stone to where it lies, with that move made."""
        fitting = []
        for plan, made in self._plans:
            for number, move in open_moves(plan, made):
                there = self._places_under(stone, move, made) if stone in stones_left(move, made) else []
                if there:
                    fitting.append((plan, {**made, number: (stone, there[0])}))
                    break
        return fitting

    def _places_under(self, stone: int, move: Move, made: Made) -> list[Place]:
        """Return the places of a move on which a stone lies."""
        return [place for place in places_left(move, made) if self._is_at(stone, place)]

    def _judge_placement(self, stone: int) -> bool:
        """Judge a stone that has been put down; return True if the episode has ended."""
        self._stone = stone
        is_place = self.nearest_intersection in self._places()
        is_near = self.placement_error_mm <= V0_TOLERANCE_MM
        if self._episode.target is not None:
            self.is_success_bomb_v0 = is_place and self._is_flat(stone) and is_near
        if self._was_lifted[stone] and self._must_be_slid(stone):
            self.failure = Failure.LIFTED
        elif self._is_at_place(stone):
            return self._take_move(stone)
        elif self._was_dropped(stone):
            self.failure = Failure.DROPPED
        else:
            self.failure = Failure.IMPRECISE if is_place else Failure.WRONG_INTERSECTION
        return True

    def _take_move(self, stone: int) -> bool:
        """Add a move to those made; return True if it was the last."""
        fitting = self._fitting(stone)
        self._is_complete = any(len(made) == len(plan) for plan, made in fitting)
        if self._is_complete:
            self.stage = Stage.PLACED
            self.is_success = self.collateral_mm <= COLLATERAL_TOLERANCE_MM
            self.failure = None if self.is_success else Failure.DISTURBED_OTHERS
            return True
        self._plans = fitting
        self._was_lifted[stone] = False
        self._left_xyz[stone] = self._now.stone_xyz[stone]
        self._rest_steps[stone] = 0
        self._movable = self._find_movable()
        if self._stone not in self._movable:
            self._stone = min(self._movable)
        return False

    def _must_be_slid(self, stone: int) -> bool:
        return all(
            move.is_slid
            for plan, made in self._plans
            for _, move in open_moves(plan, made)
            if stone in stones_left(move, made)
        )

    def _was_dropped(self, stone: int) -> bool:
        highest_m = self._episode.layout.rest_height_m + DROP_HEIGHT_M
        return is_off_board(self._now.stone_xyz[stone, :2]) or bool(self._last_touched_z[stone] > highest_m)


def is_off_board(xy: np.ndarray) -> bool:
    """Return True if a world xy, in metres, is too far from every intersection for a stone to be placed."""
    off_m = np.linalg.norm(xy - BOARD.intersection_xy(*BOARD.nearest_intersection(xy)))
    return bool(off_m > OFF_BOARD_M)
