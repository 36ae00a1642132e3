"""Small policies that point, by type: options beside those of `policy_cases`, and labels of their batches."""

from typing import Any

import torch

from lerobot_bomb.policies.board_reader import NUM_SPOTS
from lerobot_bomb.policies.pointing import OTHER_ACTIONS, OTHER_PLACES, PLACE, SPOTS, STONE

PLACES = [[-0.09, 0.09], [0.0, 0.0], [0.09, -0.045], [0.17, 0.0]]
POINTING: dict[str, dict[str, Any]] = {
    "fdvla": {"pointing": True, "pointing_places": PLACES},
    "spatialvla_grid": {"pointing": True, "pointing_places": PLACES, "pointing_cell_m": 0.04},
    # a millimetre a bin, and three digits each
    "vla0_smol": {"pointing": True, "n_action_bins": 601, "bin_mode": "levels", "number_width": 3},
}


def with_labels(batch: dict[str, Any]) -> dict[str, Any]:
    """Add places in turn, the next ones as other places, stones opposite, and boards of all colours."""
    (batch_size, *_), places = batch["action"].shape, torch.tensor(PLACES)
    number_B = torch.arange(batch_size) % len(places)
    others = places[torch.stack([number_B + 1, number_B + 2], dim=1) % len(places)]
    rest = torch.zeros(batch_size, 2, batch["action"].shape[-1] - 2)
    return batch | {
        PLACE: places[number_B],
        STONE: torch.cat([-places[number_B], torch.zeros(batch_size, 1)], dim=1),
        OTHER_PLACES: others.flatten(1),
        OTHER_ACTIONS: torch.cat([5 * others, rest], dim=2).flatten(1),
        SPOTS: (number_B[:, None] + torch.arange(NUM_SPOTS)) % 3.0,
    }
