# pyright: reportAttributeAccessIssue=false
"""LIBERO's own view of a task: its goals, whether they hold, and what of a fixture moves."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from lerobot_env_bomb.libero.scene import LiberoScene
from lerobot_env_bomb.libero.stock import mujoco

FINGER_BODIES = (
    ("gripper0_leftfinger", "gripper0_finger_joint1_tip"),
    ("gripper0_rightfinger", "gripper0_finger_joint2_tip"),
)


class LiberoTask:
    """A task in a scene that has been reset."""

    def __init__(self, scene: LiberoScene):
        self._scene = scene
        self._simulation: Any = scene._built.sim
        self._domain: Any = scene._built.env

    @property
    def goals(self) -> list[list[str]]:
        """Predicates that the task's file asks for, each with its arguments."""
        return self._domain.parsed_problem["goal_state"]

    @property
    def sites(self) -> dict[str, Any]:
        """{region: LIBERO's object of it}."""
        return self._domain.object_sites_dict

    def holds(self, goal: Sequence[str], data: "mujoco.MjData | None" = None) -> bool:
        """Return LIBERO's judgement of a goal, now or in another state of this scene."""
        wrapper = self._simulation.data
        now = wrapper._data
        wrapper._data = now if data is None else data
        try:
            return bool(self._domain._eval_predicate(list(goal)))
        finally:
            wrapper._data = now

    def joints_of(self, target: str) -> list[str]:
        """Return the names of the joints of a fixture, or of the part that a region is on."""
        found = self.sites.get(target) or self._domain.get_object(target)
        return list(getattr(found, "joints", None) or [])

    def opening_of(self, region: str) -> list[str] | None:
        """Return the goal that opens what a region is in; None if nothing of it moves."""
        site = self.sites.get(region)
        names = [] if site is None else [region, site.parent_name]
        return next((["open", name] for name in names if self.joints_of(name)), None)

    def is_gripped(self, geoms: Sequence[int]) -> bool:
        """Return True if both fingers touch these geoms."""
        model = self._scene.model
        pairs = self._scene.data.contact.geom
        pairs = np.concatenate([pairs, pairs[:, ::-1]])
        touching = pairs[np.isin(pairs[:, 1], geoms), 0]
        bodies = {model.body(body).name for body in model.geom_bodyid[touching].tolist()}
        return all(any(name in bodies for name in finger) for finger in FINGER_BODIES)

    def resting_joints(self) -> np.ndarray:
        """(7,) radians, joints that the controller draws the arm to where a pose leaves it free."""
        return np.array(self._scene._built.robots[0].controller.initial_joint)
