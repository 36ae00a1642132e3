"""Checks of a file of LIBERO's demonstrations, and the timing of its rows.

Each data/demo_N holds actions (T, 7) in -1..1: x, y, z, three of rotation, gripper; states (T, n) of the
simulator before each action; obs/agentview_rgb and obs/eye_in_hand_rgb (T, H, W, 3) uint8; obs/ee_pos
(T, 3) in metres; obs/ee_ori (T, 3), axis-angle; obs/gripper_states (T, 2) in metres; obs/joint_states (T, 7)
in radians.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_bomb.libero.episode import ACTION_DIM

CAMERAS = ("agentview_rgb", "eye_in_hand_rgb")
# of obs, in the order of LeRobot's observation.state
STATE = {"ee_pos": 3, "ee_ori": 3, "gripper_states": 2}
JOINTS = "joint_states"
NUM_JOINTS = 7  # of the arm, which a simulator's state begins with, after the time
MAX_JOINT_DIFFERENCE_RAD = 0.05  # replays of recorded actions depart a little


@dataclass(frozen=True)
class Timing:
    """Timing of a demonstration: was a row's observation taken before or after its action?"""

    # largest difference of a joint from the simulator's state of the same row, of the next; median over rows
    same_row_rad: float
    next_row_rad: float
    # how far the fingers open under +1 plus how far they close under -1, if observed before it, if after
    opening_before_m: float
    opening_after_m: float

    @classmethod
    def of(cls, values: dict[str, np.ndarray]) -> "Timing":
        """Measure the timing of a demonstration from its `checked_values`."""
        joints, fingers = values[f"obs/{JOINTS}"], values["obs/gripper_states"]
        # from the second state on: the first of some copies is of before the arm came to rest
        recorded = values["states"][1:, 1 : 1 + NUM_JOINTS]
        opening, commands = np.diff(fingers[:, 0] - fingers[:, 1]), np.sign(values["actions"][:, -1])
        return cls(
            same_row_rad=float(np.median(np.abs(joints[1:] - recorded).max(axis=1))),
            next_row_rad=float(np.median(np.abs(joints[:-1] - recorded).max(axis=1))),
            opening_before_m=float(opening @ commands[:-1]),
            opening_after_m=float(opening @ commands[1:]),
        )


def are_after(file: Path, timings: Sequence[Timing]) -> bool:
    """Return True if observations were taken after their row's action, as in the published files.

    Raises:
        ValueError: observations match no row of the simulator's states, or +1 opens the gripper.
    """
    same_row = float(np.median([timing.same_row_rad for timing in timings]))
    next_row = float(np.median([timing.next_row_rad for timing in timings]))
    if min(same_row, next_row) > MAX_JOINT_DIFFERENCE_RAD:
        raise ValueError(
            f"{file}: obs/{JOINTS} are those of no row of states, {min(same_row, next_row):.2f} rad off, so "
            "it cannot be told which action follows which observation"
        )
    is_after = next_row <= same_row
    opening = sum(timing.opening_after_m if is_after else timing.opening_before_m for timing in timings)
    if opening > 0:
        raise ValueError(
            f"{file}: the fingers open where the last of actions is positive; LIBERO's close at +1 and open "
            "at -1, so these actions are of another convention"
        )
    return is_after


def checked_values(where: str, demo: Any, image_shape: Sequence[int]) -> dict[str, np.ndarray]:
    """Check a demonstration, without reading its images; return its numbers, {name: (T, n)}."""
    widths = {"actions": ACTION_DIM, "states": None, f"obs/{JOINTS}": NUM_JOINTS}
    widths |= {f"obs/{name}": width for name, width in STATE.items()}
    for name in (*widths, *(f"obs/{camera}" for camera in CAMERAS)):
        if name not in demo:
            raise ValueError(f"{where} has no {name}; LIBERO's demonstrations do")
    num_steps = len(demo["actions"])
    if num_steps < 2:
        raise ValueError(f"{where} has {num_steps} actions; at least 2 are needed")
    for camera in CAMERAS:
        images = demo[f"obs/{camera}"]
        if images.shape != (num_steps, *image_shape) or images.dtype != np.uint8 or len(image_shape) != 3:
            raise ValueError(
                f"{where}/obs/{camera} is {images.shape} of {images.dtype}; it must be "
                f"{(num_steps, *image_shape)} of uint8, as the first image and the {num_steps} actions are"
            )
        if images.id.get_storage_size() == 0:
            raise ValueError(f"{where}/obs/{camera} was never written; get the file again")
    values = {name: np.asarray(demo[name]) for name in widths}
    for (name, array), width in zip(values.items(), widths.values(), strict=True):
        if array.ndim != 2 or len(array) != num_steps or (width and array.shape[1] != width):
            raise ValueError(
                f"{where}/{name} has the shape {array.shape}; it must be ({num_steps}, {width or 'n'})"
            )
        if not np.isfinite(array).all():
            raise ValueError(f"{where}/{name} holds NaN or infinite values")
    _check_actions(where, values["actions"])
    return values


def _check_actions(where: str, actions: np.ndarray) -> None:
    largest = float(np.abs(actions).max())
    if largest > 1 + 1e-6:
        raise ValueError(
            f"{where}/actions holds {largest:g}; LIBERO's are in -1..1, relative to where the gripper is "
            "(absolute poses are of another data set)"
        )
    if (actions[:, -1] >= 0).all():
        raise ValueError(
            f"{where}/actions: the gripper is never told to open (-1), as LIBERO's episodes begin; 0..1 is "
            "the convention of RLDS copies"
        )
