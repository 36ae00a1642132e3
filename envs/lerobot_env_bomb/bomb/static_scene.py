"""A board as at the start of an episode or in its middle, without the moves that lead there."""

from dataclasses import dataclass, replace

import numpy as np

from lerobot_bomb.bomb.expert import FLOOR_M, GRASP_DEPTH_M, SQUEEZE_M
from lerobot_bomb.bomb.layout import Layout
from lerobot_bomb.bomb.move import Aim, Made
from lerobot_bomb.bomb.observation import WORKSPACE_HIGH_M, WORKSPACE_LOW_M
from lerobot_bomb.bomb.suite import Episode
from lerobot_bomb.bomb.suites.object import MARGIN_M

HELD_RATE = 0.5  # of the scenes in which the fingers hold the stone that is meant
NEAR_RATE = 0.4  # of the scenes in which the gripper is near a stone or a place
NEAR_M = 0.025  # standard deviation of its distance, in x and in y
HEIGHT_M = (0.030, 0.140)  # of the gripper; clears stones that lie
GRIP_ERROR_M = 0.0015  # largest of a held stone between the pads, in x, y and z


@dataclass(frozen=True)
class StaticScene:
    """Scene in the middle of an episode: where everything is, and which moves have been made."""

    layout: Layout
    made: Made  # moves that have been made
    held: int | None  # stone between the fingers
    held_xyz: np.ndarray  # (3,) metres, its centre

    @property
    def opening_m(self) -> float:
        """Distance in metres between pads that hold a stone."""
        return 2 * self.layout.stone_radius_m - SQUEEZE_M


def starting_scene(episode: Episode) -> StaticScene:
    """Return the scene at the start of an episode."""
    return StaticScene(episode.layout, made={}, held=None, held_xyz=np.zeros(3))


def draw_static(episode: Episode, rng: np.random.Generator) -> StaticScene:
    """Draw a scene: some of the expert's moves made, the gripper anywhere, the next stone held or not."""
    num_made = int(rng.integers(len(episode.aims)))
    aims, aim = episode.aims[:num_made], episode.aims[num_made]
    stone_xy = episode.layout.stone_xy.copy()
    for each in aims:
        stone_xy[each.stone] = each.xy
    layout = replace(episode.layout, stone_xy=stone_xy)
    is_held = rng.random() < HELD_RATE
    gripper_xyz = _slid_xyz(layout, aim, rng) if is_held and aim.is_slid else None
    while gripper_xyz is None:
        drawn = _anywhere(layout, aim, is_held, rng)
        if is_held or not episode.gripper_is_named or _is_nearest(layout, aim.stone, episode.supply, drawn):
            gripper_xyz = drawn
    held_xyz = gripper_xyz + np.array([0.0, 0.0, GRASP_DEPTH_M])
    held_xyz += rng.uniform(-GRIP_ERROR_M, GRIP_ERROR_M, 3)
    held_xyz[2] = max(held_xyz[2], layout.rest_height_m)
    made: Made = {number: (each.stone, each.place) for number, each in enumerate(aims)}
    held = aim.stone if is_held else None
    return StaticScene(replace(layout, gripper_xyz=gripper_xyz), made, held, held_xyz)


def _anywhere(layout: Layout, aim: Aim, is_held: bool, rng: np.random.Generator) -> np.ndarray:
    """Draw the gripper's position (3,) in metres: in the workspace, or near a stone or a place."""
    low, high = np.array(WORKSPACE_LOW_M[:2]), np.array(WORKSPACE_HIGH_M[:2])
    xy = rng.uniform(low, high)
    if rng.random() < NEAR_RATE:
        stones = layout.stone_xy[layout.stone_in_play]
        center = np.array(aim.xy) if is_held else stones[rng.integers(len(stones))]
        xy = np.clip(rng.normal(center, NEAR_M), low, high)
    return np.array([*xy, rng.uniform(*HEIGHT_M)])


def _slid_xyz(layout: Layout, aim: Aim, rng: np.random.Generator) -> np.ndarray:
    """(3,) metres of the gripper around a stone on its way along the board."""
    xy = layout.stone_xy[aim.stone] + rng.random() * (np.array(aim.xy) - layout.stone_xy[aim.stone])
    return np.array([*xy, max(layout.rest_height_m - GRASP_DEPTH_M, FLOOR_M)])


def _is_nearest(layout: Layout, stone: int, supply: tuple[int, ...], gripper_xyz: np.ndarray) -> bool:
    """Return True if a stone is clearly the nearest to the gripper of those in the tray."""
    others = [other for other in supply if other != stone]
    distances = np.linalg.norm(layout.stone_xy - gripper_xyz[:2], axis=1)
    return bool((distances[others] - distances[stone] >= MARGIN_M).all())
