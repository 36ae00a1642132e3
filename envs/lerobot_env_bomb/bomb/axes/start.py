"""Perturbation axis `start`: where stone and gripper are at the start."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from lerobot_bomb.bomb.board import PATTERN_CENTER_XY, PATTERN_HALF_SIZE_M, TRAY_HALF_SIZE_XY
from lerobot_bomb.bomb.layout import Layout
from lerobot_bomb.bomb.perturbations import magnitude
from lerobot_bomb.bomb.suite import Episode
from lerobot_env_bomb.bomb.axes.transform import Transform


@dataclass(frozen=True)
class Start(Transform):
    """The stones in the tray and the gripper start elsewhere."""

    stone_offset_m: tuple[float, float]  # x, y
    gripper_offset_m: tuple[float, float]

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, nominal: Episode) -> Self:
        side = float(rng.choice((-1.0, 1.0)))
        # Towards the board, as there is no workspace beyond the tray, and to the stone's side, as the arm
        # would else hide the stone from a camera that has swung.
        angle_rad = side * rng.uniform(0.5 * np.pi, 0.75 * np.pi)
        stone_m, gripper_m = (1e-3 * magnitude("start", what, level) for what in ("stone", "gripper"))
        gripper_offset = gripper_m * np.cos(angle_rad), gripper_m * np.sin(angle_rad)
        low_m, high_m = _room_m(nominal)
        stone_offset = 0.0, min(max(side * stone_m, low_m), high_m)
        if nominal.gripper_is_named:
            gripper_offset = stone_offset
        return cls(stone_offset, (float(gripper_offset[0]), float(gripper_offset[1])))

    def arrange(self, layout: Layout, supply: tuple[int, ...]) -> Layout:
        stone_xy = layout.stone_xy.copy()
        stone_xy[list(supply)] += self.stone_offset_m
        gripper_xyz = layout.gripper_xyz + np.array([*self.gripper_offset_m, 0.0])
        return replace(layout, stone_xy=stone_xy, gripper_xyz=gripper_xyz)


def _room_m(nominal: Episode) -> tuple[float, float]:
    """Return how far the stones in the tray can go along it, down and up."""
    if not nominal.supply:
        return 0.0, 0.0
    half_m = TRAY_HALF_SIZE_XY[1] - nominal.layout.stone_radius_m
    beside_pattern_m = PATTERN_CENTER_XY[1] + PATTERN_HALF_SIZE_M + nominal.layout.stone_radius_m
    along_m = nominal.layout.stone_xy[list(nominal.supply), 1]
    low_m = beside_pattern_m if nominal.pattern else -half_m
    return low_m - along_m.min(), half_m - along_m.max()
