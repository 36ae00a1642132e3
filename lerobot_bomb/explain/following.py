"""Measure, in millimetres, of how a policy's next actions follow a changed word of the instruction."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lerobot_bomb.bomb.board import BOARD, Intersection
from lerobot_bomb.bomb.observation import reach_m
from lerobot_bomb.explain.scored_policy import Batch
from lerobot_bomb.viewing.checkpoint import LoadedPolicy


@dataclass(frozen=True)
class Following:
    """Effect of another instruction on the actions that are executed before the policy looks again."""

    instruction: str
    asked_mm: float  # from the target to the other one
    moved_mm: float  # from where the actions lead to where the others do, horizontally
    along_mm: float  # of that, towards the other target; NaN where it is the same one


def following(
    loaded: LoadedPolicy,
    observation: Batch,
    others: Mapping[str, tuple[str, Intersection]],
    target: Intersection,
    control_mode: str,
) -> dict[str, Following]:
    """Measure how actions follow each of the other instructions, from the same observation and noise."""
    clean = _end_xy(loaded, observation, control_mode)
    found = {}
    for word, (instruction, intersection) in others.items():
        moved = _end_xy(loaded, {**observation, "task": [instruction]}, control_mode) - clean
        asked = BOARD.intersection_xy(*intersection) - BOARD.intersection_xy(*target)
        asked_m = float(np.linalg.norm(asked))
        along_m = float(moved @ asked) / asked_m if asked_m else np.nan
        found[word] = Following(instruction, 1e3 * asked_m, 1e3 * float(np.linalg.norm(moved)), 1e3 * along_m)
    return found


def _end_xy(loaded: LoadedPolicy, observation: Batch, control_mode: str) -> np.ndarray:
    """(2,) metres where the next actions lead, from where the gripper is or in the world's frame."""
    loaded.begin()
    prepared = loaded.prepare(observation)
    num_steps = getattr(loaded.config, "n_action_steps", 1)
    actions = np.concatenate([loaded.act(prepared) for _ in range(num_steps)])
    return reach_m(actions, control_mode)[:2]
