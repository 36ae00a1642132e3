# pyright: reportAttributeAccessIssue=false, reportInvalidTypeForm=false
"""Simulators of BOMB: to go on from a state, to step, to say what the pads touch.

The description of the scene is MuJoCo's model for every simulator: axes edit it, cameras draw it. A simulator
other than MuJoCo reads bodies, masses and frictions from the edited model, and writes its states back.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from lerobot_bomb.bomb.board import NUM_STONES
from lerobot_env_bomb.bomb.hand import PAD_SIDES
from lerobot_env_bomb.bomb.model import stone_name
from lerobot_env_bomb.bomb.robots import Robot
from lerobot_env_bomb.shared.mujoco_gl import mujoco


class Physics(Protocol):
    """A simulator of a model whose state is kept in MuJoCo's data."""

    def begin(self) -> None:
        """Go on from the data's positions, at rest."""
        ...

    def step(self, command_xyz: np.ndarray, opening_m: float) -> None:
        """Make one physics step, the gripper drawn to (3,) metres, each finger to `opening_m`."""
        ...

    def finish(self) -> None:
        """Bring all positions in the data up to date, at the end of a control step."""
        ...

    def touched(self) -> np.ndarray:
        """(NUM_STONES, 2) bool: stones that the left and the right pad touch."""
        ...


def touched_stones(
    contacts: Iterable[Sequence[Any]], pads: Sequence[Any], number_of: Mapping[Any, int]
) -> np.ndarray:
    """(NUM_STONES, 2) bool: stones that the pads touch.

    Args:
        contacts: two bodies each, in any order.
        pads: the left and the right one.
        number_of: {body of a stone: its number}.
    """
    touched = np.zeros((NUM_STONES, 2), dtype=bool)
    for body1, body2 in contacts:
        for pad, stone in ((body1, body2), (body2, body1)):
            if pad in pads and stone in number_of:
                touched[number_of[stone], pads.index(pad)] = True
    return touched


class MujocoPhysics:
    """MuJoCo: a weld draws the gripper to a mocap body."""

    def __init__(self, robot: Robot, model: mujoco.MjModel, data: mujoco.MjData):
        self._model, self._data = model, data
        self._pads = [model.geom(f"{side}_pad").id for side in PAD_SIDES]
        self._stone_of_geom = {model.geom(stone_name(i)).id: i for i in range(NUM_STONES)}

    def begin(self) -> None:
        pass

    def step(self, command_xyz: np.ndarray, opening_m: float) -> None:
        self._data.ctrl[:] = opening_m
        self._data.mocap_pos[0] = command_xyz
        mujoco.mj_step(self._model, self._data)

    def finish(self) -> None:
        # poses and contacts of the state that the last step ended in
        mujoco.mj_forward(self._model, self._data)

    def touched(self) -> np.ndarray:
        return touched_stones(self._data.contact.geom, self._pads, self._stone_of_geom)
