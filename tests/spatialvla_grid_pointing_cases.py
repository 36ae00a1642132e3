"""Small policies of `spatialvla_grid` that point, and batches and datasets with labels."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from spatialvla_grid_cases import make_batch, make_policy

from lerobot_bomb.policies.pointing import OTHER_ACTIONS, OTHER_PLACES, PLACE, STONE
from lerobot_policy_bomb.spatialvla_grid.modeling_spatialvla_grid import SpatialvlaGridPolicy
from lerobot_policy_bomb.spatialvla_grid.pointing_spatialvla_grid import StoneCells

PLACES = [[-0.09, 0.09], [0.0, 0.0], [0.09, -0.045], [0.17, 0.0]]
STONES = StoneCells((-0.13, -0.13), (0.21, 0.13), 0.04)  # 9 x 7
NUM_STONES = 63
NAMES = ["x", "y", "z", "gripper"]
# a token a dimension
SINGLY: dict[str, Any] = {
    "action_groups": [{"dims": [dim], "transform": "identity", "bins": [8]} for dim in range(4)],
    "grid_distribution": "uniform",
    "decode_point": "mid",
}
# without reading the board: that is in test_board_reader.py
POINTING: dict[str, Any] = {
    "pointing": True,
    "board_loss_weight": 0.0,
    "pointing_places": PLACES,
    "pointing_cell_m": STONES.cell_m,
    "crop_fraction": 1.0,
    "chunk_size": 2,
    "n_action_steps": 2,
}


def pointing_policy(seed: int = 0, num_dims: int = 4, **options: Any) -> SpatialvlaGridPolicy:
    return make_policy(seed, num_dims, **POINTING | options)


def pointing_batch(policy: SpatialvlaGridPolicy, batch_size: int = 4) -> dict[str, Any]:
    """Labels that are a function of the row: places in turn, the next ones as other places."""
    batch, places = make_batch(policy, batch_size), torch.tensor(PLACES)
    number_B = torch.arange(batch_size) % len(PLACES)
    others = torch.stack([places[(number_B + 1) % len(PLACES)], places[(number_B + 2) % len(PLACES)]], dim=1)
    stone_B3 = torch.tensor([[0.055, -0.025, 0.0], [-0.5, 0.5, 1.0]])[number_B % 2]
    rest = torch.zeros(batch_size, 2, policy.grids.num_dims - 2)
    return batch | {
        PLACE: places[number_B],
        STONE: stone_B3,
        OTHER_PLACES: others.flatten(1),
        # towards the place: what an action for it is
        OTHER_ACTIONS: torch.cat([5 * others, rest], dim=2).flatten(1),
    }


def make_dataset(root: Path, places: list[list[float]] | None) -> LeRobotDatasetMetadata:
    """An episode of ten frames, with labels or without."""
    sizes = {"observation.state": 4, "action": 4}
    if places is not None:
        sizes |= {PLACE: 2, STONE: 3, OTHER_PLACES: 4, OTHER_ACTIONS: 8}
    features: dict[str, Any] = {
        key: {
            "dtype": "float32",
            "shape": (size,),
            "names": NAMES if size == 4 and key != OTHER_PLACES else None,
        }
        for key, size in sizes.items()
    }
    dataset = LeRobotDataset.create("test/pointing", fps=10, features=features, root=root, use_videos=False)
    generator = np.random.default_rng(0)
    for step in range(10):
        frame: dict[str, Any] = {
            key: generator.uniform(-0.5, 2, size).astype(np.float32) for key, size in sizes.items()
        }
        if places is not None:
            xy = np.array(places, np.float32)
            frame |= {PLACE: xy[step % 4], OTHER_PLACES: xy[[(step + 1) % 4, (step + 2) % 4]].reshape(-1)}
        dataset.add_frame({**frame, "task": "push"})
    dataset.save_episode()
    dataset.finalize()
    return LeRobotDatasetMetadata("test/pointing", root=root)
