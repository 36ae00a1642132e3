"""Masks of the objects in a camera's image."""

import numpy as np

from lerobot_bomb.bomb.board import BOARD, NUM_STONES
from lerobot_env_bomb.bomb.model import stone_name
from lerobot_env_bomb.bomb.render import Renderer, extrinsics, intrinsics
from lerobot_env_bomb.bomb.scene import Scene

STONE, TARGET, OTHER_STONES = "stone", "target", "other stones"
GRIPPER, BOARD_ITSELF, BACKGROUND = "gripper", "board", "background"
BOARD_GEOMS = ("board", "board_surface")


def object_masks(
    scene: Scene,
    renderer: Renderer,
    camera: str,
    size: int,
    stone: int,
    target_xy: np.ndarray,
    stone_radius_m: float,
) -> dict[str, np.ndarray]:
    """{object: (size, size) bool}; every pixel belongs to exactly one, besides the board's halves.

    ``stone``: index of the stone to move; ``target_xy``: (2,) metres, its target. The target is as
    much of the board as a stone there would cover, and no part of the board here; the gripper is all of the
    arm that is seen. The halves are those of the board in the world, whatever the camera sees.
    """
    model = scene.model
    geom = renderer.draw_geoms(scene.data, camera, size)
    body = np.where(geom >= 0, model.geom_bodyid[geom], 0)
    stones = [model.body(stone_name(index)).id for index in range(NUM_STONES)]
    is_board = np.isin(geom, [model.geom(name).id for name in BOARD_GEOMS])
    xy = _on_plane(scene, camera, size, BOARD.thickness_m)
    is_target = is_board & (np.linalg.norm(xy - target_xy, axis=-1) <= stone_radius_m)
    is_other = np.isin(body, stones[:stone] + stones[stone + 1 :])
    is_gripper = (geom >= 0) & (body > 0) & ~np.isin(body, stones)  # body 0 is the world
    masks = {
        STONE: body == stones[stone],
        TARGET: is_target,
        OTHER_STONES: is_other,
        GRIPPER: is_gripper,
        BOARD_ITSELF: is_board & ~is_target,
    }
    halves = {name: masks[BOARD_ITSELF] & half for name, half in BOARD.halves(xy).items()}
    return masks | halves | {BACKGROUND: ~np.any([*masks.values()], axis=0)}


def _on_plane(scene: Scene, camera: str, size: int, height_m: float) -> np.ndarray:
    """(size, size, 2) metres, where the rays through the pixels meet a horizontal plane."""
    pixels = np.stack([*np.meshgrid(np.arange(size), np.arange(size)), np.ones((size, size))], axis=-1)
    world_from_camera = extrinsics(scene.data, camera).astype(np.float64)
    rays = pixels @ np.linalg.inv(intrinsics(scene.model, camera, size)).T @ world_from_camera[:3, :3].T
    origin = world_from_camera[:3, 3]
    return origin[:2] + rays[..., :2] * ((height_m - origin[2]) / rays[..., 2:])
