"""Episodes of `bomb_libero` as the gallery shows them."""

import gymnasium
import numpy as np

from lerobot_bomb.data.libero_recording import ENV_ID
from lerobot_bomb.libero.episode import LiberoSpec
from lerobot_bomb.viewing.sheet import text_tile

ACTIONS = [[0.5, 0.0, -0.8, 0.0, 0.0, 0.0, -1.0]] * 12  # forwards and down


def libero_tiles(condition: str, seed: int, image_size: int, changes: set[str]) -> dict[str, np.ndarray]:
    """Return tiles of both cameras, upright, in the first task; dynamics show after the same actions."""
    spec = LiberoSpec(seed, perturbations=condition)
    scene = {"observation_height": image_size, "observation_width": image_size}
    env = gymnasium.make(ENV_ID, disable_env_checker=True, spec=spec, scene=scene)
    observation, _ = env.reset(seed=seed)
    tiles = {}
    if "images" in changes:
        tiles |= {name: image[::-1, ::-1] for name, image in observation["pixels"].items()}
    if "instruction" in changes:
        tiles["instruction"] = text_tile(env.get_wrapper_attr("task_description"), image_size)
    if "dynamics" in changes:
        for action in ACTIONS:
            observation, *_ = env.step(np.array(action, np.float32))
        tiles[f"after {len(ACTIONS)} steps"] = observation["pixels"]["image"][::-1, ::-1]
    env.close()
    return tiles
