# pyright: reportAttributeAccessIssue=false
"""Perturbation axis `start`: where objects and the arm are at the start."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from lerobot_bomb.libero.perturbations import libero_magnitude
from lerobot_env_bomb.libero.scene import LiberoScene, LiberoTransform
from lerobot_env_bomb.libero.stock import mujoco

MAX_OBJECTS = 32  # directions are drawn for so many, so that all levels draw the same
NUM_JOINTS = 7
NUM_TRIES = 8  # directions, an eighth of a turn apart
CLEARANCE_M = 0.02  # between what moves and everything else, at least
REACH_M = 0.36  # from the middle of the table along x and y; nothing is moved beyond


@dataclass(frozen=True)
class LiberoStart(LiberoTransform):
    """Free objects, with what lies on them, start elsewhere; the arm's joints are turned a little."""

    object_m: float
    directions_rad: tuple[float, ...]  # of the objects, in the order of the task's
    joints_rad: tuple[float, ...]  # (7,) of the arm

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Any) -> Self:
        joints = rng.standard_normal(NUM_JOINTS)
        joints *= libero_magnitude("start", "arm", level) / np.linalg.norm(joints)
        return cls(
            object_m=libero_magnitude("start", "objects", level) / 1000,
            directions_rad=tuple(rng.uniform(-np.pi, np.pi, MAX_OBJECTS).tolist()),
            joints_rad=tuple(joints.tolist()),
        )

    def arrange(self, scene: LiberoScene) -> None:
        data = scene.data
        data.qpos[scene.joints_of_robot()] += self.joints_rad
        mujoco.mj_forward(scene.model, data)
        fixed = set(scene.fixtures.values())
        for direction_rad, pile in zip(self.directions_rad, _piles(scene), strict=False):
            if not pile & fixed:
                self._move(scene, pile, direction_rad)

    def _move(self, scene: LiberoScene, pile: set[int], direction_rad: float) -> None:
        """Move a pile in the first free direction, beginning with the drawn one, if any is free."""
        others = [box for body, box in scene.boxes().items() if body not in pile]
        boxes = [box for body, box in scene.boxes().items() if body in pile]
        addresses = [int(scene.model.jnt_qposadr[scene.model.body_jntadr[body]]) for body in sorted(pile)]
        for angle_rad in direction_rad + np.arange(NUM_TRIES) * 2 * np.pi / NUM_TRIES:
            shift = self.object_m * np.array([np.cos(angle_rad), np.sin(angle_rad), 0.0])
            if all(_is_free(box + shift, others) for box in boxes):
                for address in addresses:
                    scene.data.qpos[address : address + 3] += shift
                mujoco.mj_forward(scene.model, scene.data)
                return


def _piles(scene: LiberoScene) -> list[set[int]]:
    """Return sets of touching objects and fixtures, as bodies; each object is in one set, in their order."""
    owners = scene.owners
    things = {*scene.movable.values(), *scene.fixtures.values()}
    piles = [{body} for body in things]
    pairs = owners[scene.model.geom_bodyid[scene.data.contact.geom]]
    for first, second in pairs.tolist():
        if first in things and second in things and first != second:
            joined = [pile for pile in piles if pile & {first, second}]
            piles = [pile for pile in piles if pile not in joined] + [set().union(*joined)]
    found: list[set[int]] = []
    for body in scene.movable.values():
        pile = next(pile for pile in piles if body in pile)
        if pile not in found:
            found.append(pile)
    return found


def _is_free(box: np.ndarray, others: list[np.ndarray]) -> bool:
    """Return True if a (2, 3) box from low to high is on the table and keeps its distance from the others."""
    if abs(box.mean(0)[:2]).max() > REACH_M:
        return False
    low, high = box[0] - CLEARANCE_M, box[1] + CLEARANCE_M
    return not any((low < other[1]).all() and (high > other[0]).all() for other in others)
