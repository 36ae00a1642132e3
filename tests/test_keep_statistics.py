"""A checkpoint trained further starts from its own statistics, or all of it from the dataset's."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fdvla_cases import SIZE, WORKSPACE, WRIST
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset
from lerobot.policies import make_policy, make_pre_post_processors
from pointing_cases import PLACES, POINTING
from policy_cases import CASES
from torch.utils.data import default_collate

from lerobot_bomb.checkpoints.adapters import frozen_buffers
from lerobot_bomb.policies.pointing import (
    OTHER_ACTIONS,
    OTHER_PLACES,
    PLACE,
    SPOTS,
    STONE,
    normalised_actions,
)

NAMES = ["x", "y", "z", "gripper"]
SIZES = {
    "observation.state": 4,
    "action": 4,
    PLACE: 2,
    STONE: 3,
    OTHER_PLACES: 4,
    OTHER_ACTIONS: 8,
    SPOTS: 49,
}


def make_dataset(root: Path, scale: float, offset: float) -> LeRobotDataset:
    """Write an episode whose actions follow its state; both are spread by ``scale`` around ``offset``."""
    features: dict[str, Any] = {
        key: {
            "dtype": "float32",
            "shape": (size,),
            "names": NAMES if key in ("observation.state", "action") else None,
        }
        for key, size in SIZES.items()
    }
    image = {"dtype": "image", "shape": (SIZE, SIZE, 3), "names": ["height", "width", "channels"]}
    features |= {WORKSPACE: image, WRIST: image}
    made = LeRobotDataset.create("test/units", fps=10, features=features, root=root, use_videos=False)
    rng, xy = np.random.default_rng(0), np.array(PLACES)
    for step in range(12):
        state = scale * np.sin(step + np.arange(4)) + offset
        action = state + scale * rng.uniform(-0.1, 0.1, 4)
        numbers = {
            "observation.state": state,
            "action": action,
            PLACE: xy[step % 4],
            STONE: [*xy[step % 3], 0],
            OTHER_PLACES: xy[[(step + 1) % 4, (step + 2) % 4]].ravel(),
            OTHER_ACTIONS: np.tile(action, 2),
            SPOTS: np.zeros(SIZES[SPOTS]),
        }
        frame = {key: np.asarray(values, np.float32) for key, values in numbers.items()}
        pixels = rng.integers(0, 255, (SIZE, SIZE, 3), np.uint8)
        made.add_frame({**frame, WORKSPACE: pixels, WRIST: pixels, "task": "go"})
    made.save_episode()
    made.finalize()
    return LeRobotDataset("test/units", root=root)


@pytest.fixture(scope="module")
def datasets(tmp_path_factory: pytest.TempPathFactory) -> tuple[LeRobotDataset, LeRobotDataset]:
    folder = tmp_path_factory.mktemp("units")
    return make_dataset(folder / "first", 0.1, 0.0), make_dataset(folder / "second", 0.3, 0.2)


def kept(policy: Any) -> Any:
    """Return what a checkpoint keeps of its data."""
    buffers = {name: values.tolist() for name, values in frozen_buffers(policy).items()}
    return buffers, getattr(policy.config, "grid_params", None)


@pytest.mark.parametrize("keeps", [True, False])
def test_units_are_those_of_the_processors(
    policy_type: str, keeps: bool, datasets: tuple[LeRobotDataset, LeRobotDataset], tmp_path: Path
) -> None:
    first, second = datasets
    relative = {} if policy_type == "spatialvla_grid" else {"relative_actions": True}
    config = CASES[policy_type].make_config(**POINTING[policy_type] | relative)
    old: Any = make_policy(config, ds_meta=first.meta)
    statistics: Any = first.meta.stats
    made = make_pre_post_processors(config, dataset_stats=statistics)
    for part in (old, *made):
        part.save_pretrained(tmp_path)
    raw = default_collate([second[i] for i in (2, 5)])
    with torch.no_grad():
        expected = made[1](old.predict_action_chunk(made[0](dict(raw)))[:, 0])

    further: Any = PreTrainedConfig.from_pretrained(tmp_path)
    further.pretrained_path, further.keep_statistics = tmp_path, keeps
    new: Any = make_policy(further, ds_meta=second.meta)
    statistics = {"stats": second.meta.stats}
    prepare, finish = make_pre_post_processors(
        further,
        pretrained_path=str(tmp_path),
        preprocessor_overrides={"normalizer_processor": statistics},
        postprocessor_overrides={"unnormalizer_processor": statistics},
    )
    batch = prepare(dict(raw))
    with torch.no_grad():
        actions = finish(new.predict_action_chunk(batch)[:, 0])
    assert (kept(new) == kept(old)) == keeps
    assert actions.equal(expected) == keeps

    # labels, metrics and relative actions are in the units of the batch, whoever's those are
    mode = new.config.normalization_mapping["ACTION"]
    labels = normalised_actions(raw["action"], new.pointer.action_bounds, mode)
    torch.testing.assert_close(labels, batch["action"], atol=1e-5, rtol=0)
    (one, other), (one_raw, other_raw) = batch["action"], raw["action"]
    torch.testing.assert_close((one - other) * new.action_unit, one_raw - other_raw, atol=1e-5, rtol=0)
    if relative:
        stay = prepare({**raw, "action": raw["observation.state"]})
        residual = new.to_relative(stay["action"][:, None], stay)
        torch.testing.assert_close(residual, torch.zeros(2, 1, 4), atol=1e-4, rtol=0)
        gripper = new.pointer.gripper(batch["observation.state"])
        torch.testing.assert_close(gripper, raw["observation.state"][:, :3], atol=1e-5, rtol=0)
