"""Saving, loading and adapting `spatialvla_grid`."""

import copy
import json
import logging
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies.factory import make_pre_post_processors
from lerobot.utils.constants import ACTION
from safetensors.torch import load_file, save_file
from spatialvla_grid_cases import make_batch, make_config, make_policy, stats

from lerobot_bomb.data.columns import read_columns
from lerobot_bomb.data.record import record
from lerobot_bomb.data.recording import Recording
from lerobot_policy_bomb.spatialvla_grid.modeling_spatialvla_grid import SpatialvlaGridPolicy

REPO_ID = "test/grids"
GRIPPER = {"dims": [3], "transform": "identity", "bins": [16]}


def changed(checkpoint: Path, options: dict[str, Any]) -> Any:
    """A checkpoint's config with other flags, as LeRobot's commands read it."""
    flags = [f"--{flag}={json.dumps(value)}" for flag, value in options.items()]
    return PreTrainedConfig.from_pretrained(checkpoint, cli_overrides=flags)


@pytest.fixture(scope="module")
def meta(tmp_path_factory: pytest.TempPathFactory) -> LeRobotDatasetMetadata:
    root = tmp_path_factory.mktemp("grids") / "dataset"
    record(Recording(REPO_ID, episodes=4, seed=3, image_size=32, images=True), root)
    return LeRobotDatasetMetadata(REPO_ID, root=root)


def physical_rms(policy: SpatialvlaGridPolicy, meta: LeRobotDatasetMetadata) -> float:
    """Return what the grids round off of a dataset's actions, in normalised units."""
    assert meta.stats is not None
    actions = read_columns(meta, ("action",))["action"]
    low, high = meta.stats["action"]["min"], meta.stats["action"]["max"]
    normalised = torch.from_numpy(2 * (actions - low) / (high - low) - 1).float().clamp(-1, 1)
    return float((policy.grids.decode(policy.grids.encode(normalised)) - normalised).square().mean().sqrt())


def test_grids_are_fitted_to_the_training_data(meta: LeRobotDatasetMetadata) -> None:
    even = make_policy()
    fitted = SpatialvlaGridPolicy(make_config(), dataset_meta=meta)
    assert physical_rms(fitted, meta) < 0.8 * physical_rms(even, meta)
    assert fitted.config.grid_params == fitted.grids.to_dict()
    unit = torch.from_numpy(np.asarray(meta.stats["action"]["max"] - meta.stats["action"]["min"])) / 2  # pyright: ignore[reportOptionalSubscript]
    torch.testing.assert_close(fitted.action_unit, unit.float())
    batch = make_batch(fitted, 2)
    names = {"l1_dx", "l1_dy", "l1_dz", "l1_gripper"}
    assert {"token_accuracy", "l1"} < set(fitted(batch)[1]) and len(fitted(batch)[1]) == 2 + len(names)


def test_a_loaded_checkpoint_acts_as_the_saved_one(meta: LeRobotDatasetMetadata, tmp_path: Path) -> None:
    policy = SpatialvlaGridPolicy(make_config(), dataset_meta=meta).eval()
    batch = make_batch(policy, 2)
    policy.save_pretrained(tmp_path)
    loaded = SpatialvlaGridPolicy.from_pretrained(tmp_path)
    assert torch.equal(loaded.predict_action_chunk(batch), policy.predict_action_chunk(batch))
    assert loaded.config.vlm_config == policy.config.vlm_config
    assert loaded.config.grid_params == policy.config.grid_params


FRESH = """
import sys, torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
import lerobot_policy_bomb
folder = sys.argv[1]
config = PreTrainedConfig.from_pretrained(folder)
policy = get_policy_class(config.type).from_pretrained(folder)
preprocessor, _ = make_pre_post_processors(policy.config, folder)
torch.save(policy.predict_action_chunk(preprocessor(torch.load(f"{folder}/raw.pt"))), f"{folder}/chunk.pt")
"""


@pytest.mark.long
def test_a_fresh_process_without_network_acts_alike(tmp_path: Path) -> None:
    policy = make_policy()
    policy.save_pretrained(tmp_path)
    preprocessor, postprocessor = make_pre_post_processors(policy.config, dataset_stats=stats())
    for pipeline in (preprocessor, postprocessor):
        pipeline.save_pretrained(tmp_path)
    raw: dict[str, Any] = {key: torch.rand(2, 3, 64, 64) for key in policy._cameras}
    raw |= {"observation.state": torch.rand(2, 4), "task": ["put the black stone", "go"]}
    torch.save(raw, tmp_path / "raw.pt")
    environment = {**os.environ, "HF_HOME": str(tmp_path / "empty"), "HF_HUB_OFFLINE": "1"}
    subprocess.run([sys.executable, "-c", FRESH, str(tmp_path)], check=True, env=environment)
    expected = policy.predict_action_chunk(preprocessor(raw))
    assert torch.equal(torch.load(tmp_path / "chunk.pt"), expected)


def test_a_missing_or_unexpected_tensor_is_an_error(tmp_path: Path) -> None:
    make_policy().save_pretrained(tmp_path)
    weights = load_file(tmp_path / "model.safetensors")
    head = weights.pop("cell_head.weight")
    save_file(weights, tmp_path / "model.safetensors")
    with pytest.raises(ValueError, match=r"lacks cell_head\.weight"):
        SpatialvlaGridPolicy.from_pretrained(tmp_path)
    save_file(weights | {"cell_head.weight": head, "extra": head.clone()}, tmp_path / "model.safetensors")
    with pytest.raises(ValueError, match="has extra"):
        SpatialvlaGridPolicy.from_pretrained(tmp_path)


def test_fine_tuning_moves_the_grids_and_both_tables(
    meta: LeRobotDatasetMetadata, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Cells mean other actions afterwards; their rows are those of where the actions lay before."""
    old = make_policy()
    with torch.no_grad():  # rows that say where a cell lies
        for group, (first, num) in enumerate(zip(old.grids.offsets, old.grids.num_cells, strict=True)):
            values = old.grids.decode_group(group, torch.arange(num), "mid")
            for table in (old.cell_embedding.weight, old.cell_head.weight):
                table[first : first + num, : values.shape[1]] = values
    old.save_pretrained(tmp_path)
    with caplog.at_level(logging.INFO):
        new = SpatialvlaGridPolicy.from_pretrained(tmp_path, dataset_meta=meta)
    assert "Action grids adapted" in caplog.text
    assert new.config.grid_params != old.config.grid_params
    assert new.config.grid_params == new.grids.to_dict()
    gripper = slice(new.grids.offsets[1], None)
    middles = new.grids.decode_group(1, torch.arange(new.grids.num_cells[1]), "mid")[:, 0]
    inside = middles.abs() < 1 - 1 / 16  # beyond the outermost middles, the outermost row stays
    for table in (new.cell_embedding.weight, new.cell_head.weight):
        torch.testing.assert_close(table[gripper, 0][inside], middles[inside], rtol=0, atol=2e-3)
    new.save_pretrained(tmp_path / "adapted")
    again = SpatialvlaGridPolicy.from_pretrained(tmp_path / "adapted")
    batch = make_batch(new, 2)
    assert torch.equal(again.predict_action_chunk(batch), new.eval().predict_action_chunk(batch))


@pytest.mark.parametrize(
    "options",
    [
        {"grid_distribution": "quantile", "rho_dead": 0.05},
        {"action_groups": [{"dims": [0, 1, 2], "transform": "polar", "bins": [4, 8, 6]}, GRIPPER]},
    ],
)
def test_fine_tuning_takes_the_grids_that_flags_ask_for(
    options: dict[str, Any], meta: LeRobotDatasetMetadata, tmp_path: Path
) -> None:
    make_policy().save_pretrained(tmp_path)
    new = SpatialvlaGridPolicy.from_pretrained(tmp_path, config=changed(tmp_path, options), dataset_meta=meta)
    fresh = SpatialvlaGridPolicy(make_config(**options), dataset_meta=meta)
    assert new.grids.to_dict() == fresh.grids.to_dict() == new.config.grid_params
    assert new.cell_head.weight.shape == fresh.cell_head.weight.shape
    batch = make_batch(new, 2)
    new(batch)[0].backward()
    assert new.cell_embedding.weight.grad is not None
    new.save_pretrained(tmp_path / "new")
    again = SpatialvlaGridPolicy.from_pretrained(tmp_path / "new")
    assert torch.equal(again.predict_action_chunk(batch), new.predict_action_chunk(batch))


def test_a_checkpoint_may_decode_to_another_point(meta: LeRobotDatasetMetadata, tmp_path: Path) -> None:
    policy = SpatialvlaGridPolicy(make_config(), dataset_meta=meta)
    policy.save_pretrained(tmp_path)
    options = {"decode_point": "mid"}
    middle = SpatialvlaGridPolicy.from_pretrained(tmp_path, config=changed(tmp_path, options))
    cells = torch.arange(policy.grids.num_cells[0])
    assert torch.equal(middle.grids.decode_group(0, cells), policy.grids.decode_group(0, cells, "mid"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"grid_distribution": "uniform"},
            "grid_distribution='uniform': this checkpoint's grids have 'gauss",
        ),
        ({"rho_dead": 0.1}, "rho_dead=0.1: this checkpoint's grids have None, which only a training"),
        ({"decode_point": "centroid"}, "decode_point='centroid': this checkpoint's grids have 'cond_mean'"),
        ({"chunk_size": 8}, "chunk_size=8: this checkpoint was trained with 4"),
        (
            {"prefix_attention": "causal"},
            "prefix_attention='causal': this checkpoint was trained with 'bidir",
        ),
    ],
)
def test_what_a_checkpoint_was_trained_with_cannot_be_changed_in_evaluation(
    options: dict[str, Any], message: str, tmp_path: Path
) -> None:
    make_policy().save_pretrained(tmp_path)
    with pytest.raises(ValueError, match=rf"--policy\.{message}"):
        SpatialvlaGridPolicy.from_pretrained(tmp_path, config=changed(tmp_path, options))


def test_what_seven_dims_are_is_told_by_names_or_a_flag_and_kept_in_the_checkpoint(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"--policy\.action_layout is not given"):
        make_policy(num_dims=7, action_layout=None)
    for layout, num_groups in (("pose", 3), ("joints", 7)):
        policy = make_policy(num_dims=7, action_layout=layout)
        assert [len(policy.grids.groups), policy._newest_only()] == [num_groups, [6] * (layout == "pose")]
        policy.save_pretrained(tmp_path / layout)
        loaded = SpatialvlaGridPolicy.from_pretrained(tmp_path / layout)
        assert loaded.grids.to_dict() == policy.grids.to_dict()
    # of before there was a flag: what its grids say
    config = json.loads((tmp_path / "pose" / "config.json").read_text())
    del config["action_layout"]
    (tmp_path / "pose" / "config.json").write_text(json.dumps(config))
    assert len(SpatialvlaGridPolicy.from_pretrained(tmp_path / "pose").grids.groups) == 3
    with pytest.raises(ValueError, match=r"--policy\.action_groups=.*: this checkpoint's grids have"):
        wrong = changed(tmp_path / "pose", {"action_layout": "joints"})
        SpatialvlaGridPolicy.from_pretrained(tmp_path / "pose", config=wrong)


def test_a_datasets_names_make_the_groups(meta: LeRobotDatasetMetadata) -> None:
    renamed = copy.deepcopy(meta)
    renamed.info.features[ACTION]["names"] = ["base", "shoulder", "elbow", "gripper"]
    assert [
        len(group.dims) for group in SpatialvlaGridPolicy(make_config(), dataset_meta=meta).grids.groups
    ] == [
        3,
        1,
    ]
    policy = SpatialvlaGridPolicy(make_config(), dataset_meta=renamed)
    assert [len(group.dims) for group in policy.grids.groups] == [1] * 4


def test_fine_tuning_may_keep_the_grids(meta: LeRobotDatasetMetadata, tmp_path: Path) -> None:
    old = make_policy(adapt_embeddings=False)
    old.save_pretrained(tmp_path)
    new = SpatialvlaGridPolicy.from_pretrained(tmp_path, dataset_meta=meta)
    assert new.config.grid_params == old.config.grid_params
    assert torch.equal(new.cell_head.weight, old.cell_head.weight)
