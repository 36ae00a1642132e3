"""Pointing of the expert: columns of a recording that only training reads, never an observation.

Which stone goes to which place is what a policy must read before it can act; what the expert would do for
other places teaches it to act as it has pointed.
"""

from dataclasses import dataclass, replace

import numpy as np

from lerobot_bomb.bomb.board import BOARD
from lerobot_bomb.bomb.commands import CELLS, TRAY_XY_M
from lerobot_bomb.bomb.expert import current_goal, expert_action, held_share
from lerobot_bomb.bomb.observation import ACTION_DIM
from lerobot_bomb.bomb.privileged_state import Goal, PrivilegedState

NUM_OTHERS = 2  # places a frame, beside the one that is meant
# where the expert puts stones
PLACES_XY_M = (*(tuple(BOARD.intersection_xy(*cell).tolist()) for cell in CELLS), *TRAY_XY_M)
PREFIX = "pointing."
# name -> names of its numbers; metres, shares, actions of the environment
COLUMNS = {
    f"{PREFIX}place": ("x", "y"),
    f"{PREFIX}stone": ("x", "y", "held"),
    f"{PREFIX}other_places": tuple(f"{axis}{i}" for i in range(NUM_OTHERS) for axis in "xy"),
    f"{PREFIX}other_actions": tuple(
        f"action{i}_{dim}" for i in range(NUM_OTHERS) for dim in range(ACTION_DIM)
    ),
}


@dataclass(frozen=True)
class Pointing:
    """Place and stone of the expert's current move, and what it would do for other places."""

    place_xy: np.ndarray  # (2,) metres
    stone_xy: np.ndarray  # (2,) metres
    held: float  # how far the fingers hold that stone, in [0, 1]
    other_places_xy: np.ndarray  # (NUM_OTHERS, 2) metres
    other_actions: np.ndarray  # (NUM_OTHERS, ACTION_DIM), in the environment's units

    @classmethod
    def of(cls, state: PrivilegedState, rng: np.random.Generator) -> "Pointing":
        """Point, and draw other places."""
        goal = current_goal(state)
        others = [PLACES_XY_M[i] for i in rng.integers(len(PLACES_XY_M), size=NUM_OTHERS)]
        return cls(
            place_xy=goal.xyz[:2],
            stone_xy=state.stone_xyz[goal.stone, :2],
            held=held_share(state, goal.stone),
            other_places_xy=np.array(others),
            other_actions=np.stack([expert_action(_aimed_at(state, goal, xy)) for xy in others]),
        )

    def columns(self) -> dict[str, np.ndarray]:
        """{name: its numbers, (n,) float32}."""
        values = (
            self.place_xy,
            np.append(self.stone_xy, self.held),
            self.other_places_xy,
            self.other_actions,
        )
        return {
            name: value.reshape(-1).astype(np.float32) for name, value in zip(COLUMNS, values, strict=True)
        }


def _aimed_at(state: PrivilegedState, goal: Goal, xy: tuple[float, float]) -> PrivilegedState:
    return replace(state, goals=(replace(goal, xyz=np.array([*xy, goal.xyz[2]])),))
