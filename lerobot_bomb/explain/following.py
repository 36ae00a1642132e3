"""Measure, in millimetres, of how a policy's next actions follow a changed word of the instruction."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lerobot_bomb.bomb.board import BOARD, Intersection
from lerobot_bomb.explain.next_actions import NextActions


@dataclass(frozen=True)
class Following:
    """Effect of another instruction on the actions that are executed before the policy looks again."""

    instruction: str
    asked_mm: float  # from the target to the other one
    moved_mm: float  # from where the actions lead to where the others do, horizontally
    along_mm: float  # of that, towards the other target; NaN where it is the same one


def following(
    actions: NextActions, others: Mapping[str, tuple[str, Intersection]], target: Intersection
) -> dict[str, Following]:
    """Measure how actions follow each of the other instructions, from the same observation and noise."""
    found = {}
    for word, (instruction, intersection) in others.items():
        moved = (actions.reached_m({"task": [instruction]}) - actions.clean_m)[:2]
        asked = BOARD.intersection_xy(*intersection) - BOARD.intersection_xy(*target)
        asked_m = float(np.linalg.norm(asked))
        along_m = float(moved @ asked) / asked_m if asked_m else np.nan
        found[word] = Following(instruction, 1e3 * asked_m, 1e3 * float(np.linalg.norm(moved)), 1e3 * along_m)
    return found
