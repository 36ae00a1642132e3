"""Pointing: which stone goes where, by the expert and by a policy.

A policy must see the stones before it can point, and point before it can act. The expert's actions for other
places teach it to act as it has pointed. A recording has all of this in columns that only training reads,
never in an observation.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from lerobot_bomb.bomb.board import BOARD, TRAY_CENTER_XY, TRAY_HALF_SIZE_XY
from lerobot_bomb.bomb.commands import INTERSECTIONS, TRAY_XY_M
from lerobot_bomb.bomb.expert import current_goal, expert_action, held_share
from lerobot_bomb.bomb.judge import LIFT_M
from lerobot_bomb.bomb.observation import ACTION_DIM
from lerobot_bomb.bomb.privileged_state import Goal, PrivilegedState

ON_INTERSECTION_M = 0.008  # a stone this near one lies on it
TRAY_SPOT_M = 0.015  # side of a square of the tray: smaller than a stone, so that no two lie in one
# height of its centre from which a stone is off the board
LIFTED_M = BOARD.thickness_m + BOARD.stone_height_m / 2 + LIFT_M
HELD = 0.5  # from this share on a stone counts as held
NUM_OTHERS = 2  # other places per frame, beside the expert's


def _middles(half_m: float) -> list[float]:
    """Return the middles of squares along a side of the tray: metres from its centre, itself a middle."""
    number = round(half_m / TRAY_SPOT_M)
    return [TRAY_SPOT_M * i for i in range(-number, number + 1)]


# where the expert puts stones
PLACES_XY_M = (
    *(tuple(BOARD.intersection_xy(*intersection).tolist()) for intersection in INTERSECTIONS),
    *TRAY_XY_M,
)
# the tray's squares, row by row from the far one
TRAY_SPOTS_XY_M = tuple(
    (round(TRAY_CENTER_XY[0] + x, 6), round(TRAY_CENTER_XY[1] - y, 6))
    for y in _middles(TRAY_HALF_SIZE_XY[1])
    for x in _middles(TRAY_HALF_SIZE_XY[0])
)
# where stones are looked for: intersections, row by row, then the tray; and how near such a stone is
SPOTS_XY_M = (*PLACES_XY_M[: len(INTERSECTIONS)], *TRAY_SPOTS_XY_M)
SPOT_REACH_M = np.repeat(
    [ON_INTERSECTION_M, TRAY_SPOT_M / 2**0.5], [len(INTERSECTIONS), len(TRAY_SPOTS_XY_M)]
)
PREFIX = "pointing."
# name -> names of its numbers; metres, shares, actions of the environment, colours of `colors_on_spots`
COLUMNS = {
    f"{PREFIX}place": ("x", "y"),
    f"{PREFIX}stone": ("x", "y", "held"),
    f"{PREFIX}other_places": tuple(f"{axis}{i}" for i in range(NUM_OTHERS) for axis in "xy"),
    f"{PREFIX}other_actions": tuple(
        f"action{i}_{dim}" for i in range(NUM_OTHERS) for dim in range(ACTION_DIM)
    ),
    f"{PREFIX}spots": (
        *(f"row{row}_column{column}" for row, column in INTERSECTIONS),
        *(f"tray{i}" for i in range(len(TRAY_SPOTS_XY_M))),
    ),
}


@dataclass(frozen=True)
class Meant:
    """A stone and the place where the expert brings it."""

    place_xy: np.ndarray  # (2,) metres
    stone_xy: np.ndarray  # (2,) metres
    held: float  # how far the fingers hold that stone, in [0, 1]

    @classmethod
    def in_state(cls, state: PrivilegedState) -> Self:
        """Read the expert's stone and place from the true state."""
        goal = current_goal(state)
        return cls(goal.xyz[:2], state.stone_xyz[goal.stone, :2], held_share(state, goal.stone))


@dataclass(frozen=True)
class PointedAt:
    """A stone and its place, as a policy predicts them."""

    place_xy: np.ndarray  # (2,) metres
    stone_xy: np.ndarray  # (2,) metres
    held: float | None = None  # probability that the fingers hold that stone; None: it says nothing of it
    # place (x, y) of a table -> probability that it is the one; {} without a table
    probabilities: Mapping[tuple[float, float], float] = field(default_factory=dict)

    @property
    def likeliest(self) -> list[tuple[tuple[float, float], float]]:
        """Places with their probabilities, the likeliest first."""
        return sorted(self.probabilities.items(), key=lambda each: -each[1])


@dataclass(frozen=True)
class Pointing(Meant):
    """Stone and place in a state, and the expert's actions for other places."""

    other_places_xy: np.ndarray  # (NUM_OTHERS, 2) metres
    other_actions: np.ndarray  # (NUM_OTHERS, ACTION_DIM), in the environment's units
    spots: np.ndarray  # as `colors_on_spots` has them

    @classmethod
    def of(cls, state: PrivilegedState, rng: np.random.Generator) -> Self:
        """Read stone and place from the state, and draw other places."""
        goal = current_goal(state)
        others = [PLACES_XY_M[i] for i in rng.integers(len(PLACES_XY_M), size=NUM_OTHERS)]
        return cls(
            **vars(Meant.in_state(state)),
            other_places_xy=np.array(others),
            other_actions=np.stack([expert_action(_aimed_at(state, goal, xy)) for xy in others]),
            spots=colors_on_spots(state),
        )

    def columns(self) -> dict[str, np.ndarray]:
        """{name: its numbers, (n,) float32}."""
        values = (
            self.place_xy,
            np.append(self.stone_xy, self.held),
            self.other_places_xy,
            self.other_actions,
            self.spots,
        )
        return {
            name: value.reshape(-1).astype(np.float32) for name, value in zip(COLUMNS, values, strict=True)
        }


def colors_on_spots(state: PrivilegedState) -> np.ndarray:
    """(S,) int64 for `SPOTS_XY_M`: 0 where no stone lies, 1 for a black one, 2 for a white one."""
    lies = state.stone_in_play & (state.stone_xyz[:, 2] < LIFTED_M)
    ways = np.array(SPOTS_XY_M)[:, None] - state.stone_xyz[lies, :2]
    apart_m = np.linalg.norm(ways, axis=2)
    nearest = apart_m.argmin(axis=0)
    is_on = apart_m.min(axis=0) <= SPOT_REACH_M[nearest]
    colors = np.zeros(len(SPOTS_XY_M), dtype=np.int64)
    colors[nearest[is_on]] = 1 + state.stone_is_white[lies][is_on]
    return colors


def action_for(state: PrivilegedState, pointed: PointedAt) -> np.ndarray:
    """(4,) the expert's action if stone and place were where ``pointed`` says; the grip stays as it is."""
    goal, stone_xyz = current_goal(state), state.stone_xyz.copy()
    if held_share(state, goal.stone) < HELD:
        stone_xyz[goal.stone, :2] = pointed.stone_xy
    x, y = pointed.place_xy.tolist()
    return expert_action(_aimed_at(replace(state, stone_xyz=stone_xyz), goal, (x, y)))


def _aimed_at(state: PrivilegedState, goal: Goal, xy: tuple[float, float]) -> PrivilegedState:
    return replace(state, goals=(replace(goal, xyz=np.array([*xy, goal.xyz[2]])),))
