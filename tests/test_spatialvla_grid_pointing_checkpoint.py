"""`spatialvla_grid` that points: what it takes from a dataset and keeps in a checkpoint, and bad input."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDatasetMetadata
from spatialvla_grid_cases import make_batch, make_config, make_policy
from spatialvla_grid_pointing_cases import (
    NUM_STONES,
    PLACES,
    POINTING,
    make_dataset,
    pointing_batch,
    pointing_policy,
)

from lerobot_bomb.flag_errors import FlagError
from lerobot_bomb.policies.pointing import OTHER_ACTIONS
from lerobot_policy_bomb.spatialvla_grid.modeling_spatialvla_grid import SpatialvlaGridPolicy

# Data and checkpoints


@pytest.fixture(scope="module")
def metas(tmp_path_factory: pytest.TempPathFactory) -> dict[str, LeRobotDatasetMetadata]:
    folder = tmp_path_factory.mktemp("pointing")
    return {
        name: make_dataset(folder / name, PLACES if name == "pointing" else None)
        for name in ("pointing", "plain")
    }


def changed(checkpoint: Path, **options: Any) -> Any:
    flags = [f"--{flag}={json.dumps(value)}" for flag, value in options.items()]
    return PreTrainedConfig.from_pretrained(checkpoint, cli_overrides=flags)


def test_places_and_what_other_actions_are_come_from_the_dataset(
    metas: dict[str, LeRobotDatasetMetadata],
) -> None:
    options: dict[str, Any] = {**POINTING, "pointing_places": None}
    policy = SpatialvlaGridPolicy(make_config(**options), metas["pointing"])
    assert policy.config.pointing_places is not None
    assert sorted(policy.config.pointing_places) == sorted(PLACES)
    assert policy.pointer is not None and metas["pointing"].stats is not None
    stats = metas["pointing"].stats["action"]
    highest = torch.from_numpy(np.asarray(stats["max"])).float()
    batch = pointing_batch(policy) | {OTHER_ACTIONS: highest.repeat(4, 2)}
    policy.config.counterfactual_share = 1.0
    cells, _, _ = policy._targets(batch)
    assert torch.equal(cells[:, 0], policy.grids.encode(torch.ones(4, 4)))


def test_grids_adapt_and_what_points_stays(metas: dict[str, LeRobotDatasetMetadata], tmp_path: Path) -> None:
    old = pointing_policy()
    old.save_pretrained(tmp_path / "old")
    loaded = SpatialvlaGridPolicy.from_pretrained(tmp_path / "old")
    batch = make_batch(old, 2)
    assert torch.equal(loaded.write(batch, 2), old.write(batch, 2))
    groups = [
        {"dims": [0, 1, 2], "transform": "polar", "bins": [4, 8, 6]},
        {"dims": [3], "transform": "identity", "bins": [16]},
    ]
    config = changed(tmp_path / "old", action_groups=groups)
    new = SpatialvlaGridPolicy.from_pretrained(
        tmp_path / "old", config=config, dataset_meta=metas["pointing"]
    )
    assert new.grids.num_cells == [4 * 8 * 6, 16] != old.grids.num_cells
    for table in ("cell_embedding.weight", "cell_head.weight"):
        (of_old, of_new) = (policy.get_parameter(table) for policy in (old, new))
        assert len(of_new) == 4 * 8 * 6 + 16 + 4 + NUM_STONES
        assert torch.equal(of_new[-4 - NUM_STONES :], of_old[-4 - NUM_STONES :])
    new(pointing_batch(new))[0].backward()
    new.save_pretrained(tmp_path / "new")
    again = SpatialvlaGridPolicy.from_pretrained(tmp_path / "new")
    assert torch.equal(again.write(batch, 2), new.write(batch, 2))
    assert again.config.pointing_places == PLACES


# Bad input


def test_without_places_there_is_no_policy() -> None:
    with pytest.raises(ValueError, match=r"--policy\.pointing=true takes the places from a dataset"):
        make_policy(pointing=True)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"counterfactual_share": 1.5}, r"--policy\.counterfactual_share=1\.5 must lie in 0\.\.1"),
        ({"pointing_cell_m": 5.0}, r"--policy\.pointing_cell_m=5\.0 must lie in 0\.001\.\.0\.05"),
        ({"pointing_area_m": [[0, 0], [1]]}, r"--policy\.pointing_area_m=.* must be \[\[x, y\], \[x, y\]\]"),
        ({"pointing_area_m": [[0, 1], [1, 0]]}, "the second beyond the first"),
    ],
)
def test_wrong_flags_are_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(FlagError, match=message):
        make_config(**POINTING | options)


def test_a_start_that_does_not_go_together_is_refused(
    metas: dict[str, LeRobotDatasetMetadata], tmp_path: Path
) -> None:
    make_policy().save_pretrained(tmp_path / "plain")
    pointing_policy(chunk_size=4, n_action_steps=4).save_pretrained(tmp_path / "pointing")
    load = SpatialvlaGridPolicy.from_pretrained
    with pytest.raises(
        ValueError, match=r"pointing=true is trained on the columns .*which test/pointing lacks"
    ):
        load(tmp_path / "pointing", config=changed(tmp_path / "pointing"), dataset_meta=metas["plain"])
    with pytest.raises(
        ValueError, match=r"--policy\.pointing=True: the weights of this checkpoint are made for"
    ):
        on = changed(tmp_path / "plain", pointing=True)
        load(tmp_path / "plain", config=on, dataset_meta=metas["pointing"])
    with pytest.raises(
        ValueError, match=r"--policy\.pointing=False: the weights of this checkpoint are made"
    ):
        off = changed(tmp_path / "pointing", pointing=False)
        load(tmp_path / "pointing", config=off, dataset_meta=metas["plain"])


@pytest.mark.parametrize("with_data", [True, False])
def test_a_checkpoint_of_before_does_not_point(
    with_data: bool, metas: dict[str, LeRobotDatasetMetadata], tmp_path: Path
) -> None:
    make_policy().save_pretrained(tmp_path)
    written = json.loads((tmp_path / "config.json").read_text())
    for name in [name for name in written if name.startswith(("pointing", "counterfactual"))]:
        del written[name]
        written["trained_with"].pop(name, None)
    (tmp_path / "config.json").write_text(json.dumps(written))
    with pytest.raises(ValueError, match=r"--policy\.pointing=True: .*this checkpoint"):
        SpatialvlaGridPolicy.from_pretrained(
            tmp_path,
            config=changed(tmp_path, pointing=True),
            dataset_meta=metas["pointing"] if with_data else None,
        )
    SpatialvlaGridPolicy.from_pretrained(tmp_path, config=changed(tmp_path))
