"""Saving and loading `fdvla`, and what it takes from a dataset."""

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fdvla_cases import make_batch, make_config, make_policy, stats
from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies.factory import make_pre_post_processors
from safetensors.torch import load_file, save_file

from lerobot_bomb.actions.relative import bounds
from lerobot_bomb.commands.main import main
from lerobot_bomb.data.record import record
from lerobot_bomb.data.recording import Recording
from lerobot_policy_bomb.fdvla.modeling_fdvla import FdvlaPolicy

REPO_ID = "test/fdvla"


def changed(checkpoint: Path, options: dict[str, Any]) -> Any:
    """A checkpoint's config with other flags, as LeRobot's commands read it."""
    flags = [f"--{flag}={json.dumps(value)}" for flag, value in options.items()]
    return PreTrainedConfig.from_pretrained(checkpoint, cli_overrides=flags)


@pytest.mark.parametrize("options", [{}, {"use_denoise_head": False, "dualmod_flow": False}])
def test_a_loaded_checkpoint_acts_as_the_saved_one(options: dict[str, Any], tmp_path: Path) -> None:
    policy = make_policy(seed=3, **options)
    with torch.no_grad():  # zeros and ones of an initialisation would pass for loaded values
        for parameter in policy.parameters():
            parameter.add_(0.01)
    batch = make_batch(policy, 2)
    policy.save_pretrained(tmp_path)
    loaded = FdvlaPolicy.from_pretrained(tmp_path)
    assert torch.equal(loaded.predict_action_chunk(batch), policy.predict_action_chunk(batch))
    assert loaded.config.vlm_config == policy.config.vlm_config
    assert not any("generator" in name for name in load_file(tmp_path / "model.safetensors"))


def test_a_copy_of_the_policy_acts_alike() -> None:
    policy = make_policy()
    batch = make_batch(policy, 2)
    assert torch.equal(copy.deepcopy(policy).predict_action_chunk(batch), policy.predict_action_chunk(batch))


def test_a_missing_or_unexpected_tensor_is_an_error(tmp_path: Path) -> None:
    make_policy().save_pretrained(tmp_path)
    weights = load_file(tmp_path / "model.safetensors")
    marks = weights.pop("segment.marks")
    save_file(weights, tmp_path / "model.safetensors")
    with pytest.raises(ValueError, match=r"lacks segment\.marks"):
        FdvlaPolicy.from_pretrained(tmp_path)
    save_file(weights | {"segment.marks": marks, "extra": marks.clone()}, tmp_path / "model.safetensors")
    with pytest.raises(ValueError, match="has extra"):
        FdvlaPolicy.from_pretrained(tmp_path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"chunk_size": 8}, "chunk_size=8: this checkpoint was trained with 4"),
        ({"image_size": 84}, "image_size=84: this checkpoint was trained with 56"),
        ({"reasoning_pool": "last"}, "reasoning_pool='last': this checkpoint was trained with 'text'"),
        ({"use_denoise_head": False}, "use_denoise_head=False: this checkpoint was trained with True"),
        ({"dualmod_flow": False}, "dualmod_flow=False: this checkpoint was trained with True"),
        (
            {"segment_attention": "causal"},
            "segment_attention='causal': this checkpoint was trained with 'b",
        ),
    ],
)
def test_what_a_checkpoint_was_trained_with_cannot_be_changed_in_evaluation(
    options: dict[str, Any], message: str, tmp_path: Path
) -> None:
    make_policy().save_pretrained(tmp_path)
    with pytest.raises(ValueError, match=rf"--policy\.{message}"):
        FdvlaPolicy.from_pretrained(tmp_path, config=changed(tmp_path, options))


def test_a_checkpoint_may_sample_otherwise(tmp_path: Path) -> None:
    policy = make_policy()
    batch, noise = make_batch(policy, 1), torch.zeros(1, 4, 4)
    usual = policy.predict_action_chunk(batch, noise)
    policy.save_pretrained(tmp_path)
    for options in ({"sampler": "flow"}, {"num_inference_steps": 7}, {"refine_alpha": 0.9}):
        other = FdvlaPolicy.from_pretrained(tmp_path, config=changed(tmp_path, options)).eval()
        assert not torch.equal(other.predict_action_chunk(batch, noise), usual)


def test_an_exported_backbone_is_where_another_policy_starts(tmp_path: Path) -> None:
    policy = make_policy(seed=7)
    policy.save_pretrained(tmp_path / "checkpoint")
    for pipeline in make_pre_post_processors(policy.config, dataset_stats=stats()):
        pipeline.save_pretrained(tmp_path / "checkpoint")
    base = tmp_path / "base"
    assert (
        main(
            ["checkpoint", "export-backbone", f"--policy.path={tmp_path / 'checkpoint'}", f"--output={base}"]
        )
        == 0
    )
    other = make_policy(vlm_model_name=str(base), num_dims=2, image_size=84)
    weights = other.backbone.state_dict()
    assert weights and all(torch.equal(weights[k], w) for k, w in policy.backbone.state_dict().items())
    assert other.tokens == policy.tokens


# Data


@pytest.fixture(scope="module")
def meta(tmp_path_factory: pytest.TempPathFactory) -> LeRobotDatasetMetadata:
    root = tmp_path_factory.mktemp("recorded") / "dataset"
    record(Recording(REPO_ID, episodes=2, seed=3, image_size=32, images=True), root)
    return LeRobotDatasetMetadata(REPO_ID, root=root)


@pytest.mark.parametrize("options", [{}, {"use_flow_head": False}])
def test_errors_are_told_in_the_datasets_units(options: dict[str, Any], meta: LeRobotDatasetMetadata) -> None:
    policy = FdvlaPolicy(make_config(**options), dataset_meta=meta)
    assert meta.stats is not None
    std = torch.from_numpy(np.asarray(meta.stats["action"]["std"])).float()
    torch.testing.assert_close(policy.action_unit, std)
    batch = make_batch(policy, 2)
    metrics = policy(batch)[1]
    names = ["l1_dx", "l1_dy", "l1_dz", "l1_gripper"]
    assert {"l1", *names} < set(metrics)
    assert metrics["l1"] == pytest.approx(sum(metrics[name] for name in names) / 4, rel=1e-5)
    policy.action_unit *= 2
    policy.config.trained_batches = 0
    once = policy(batch)[1]["l1"]
    policy.action_unit /= 2
    policy.config.trained_batches = 0
    assert policy(batch)[1]["l1"] == pytest.approx(once / 2)


@pytest.mark.parametrize(
    ("options", "then"),
    [
        ({"chunk_size": 8}, "4"),
        ({"head_dim": 64}, "32"),
        ({"dualmod_dim": 8}, "16"),
        ({"use_denoise_head": False}, "True"),
        ({"use_state": False}, "True"),
    ],
)
def test_a_training_cannot_continue_with_other_shapes(
    options: dict[str, Any], then: str, meta: LeRobotDatasetMetadata, tmp_path: Path
) -> None:
    make_policy().save_pretrained(tmp_path)
    [(flag, value)] = options.items()
    message = rf"--policy\.{flag}={value}: the weights of this checkpoint are made for {then}; only a"
    with pytest.raises(ValueError, match=message):
        FdvlaPolicy.from_pretrained(tmp_path, config=changed(tmp_path, options), dataset_meta=meta)


def test_a_training_may_continue_otherwise(meta: LeRobotDatasetMetadata, tmp_path: Path) -> None:
    make_policy().save_pretrained(tmp_path)
    options = {"image_size": 84, "segment_attention": "causal", "reasoning_pool": "last"}
    config = changed(tmp_path, options)
    policy = FdvlaPolicy.from_pretrained(tmp_path, config=config, dataset_meta=meta)
    assert policy.config.trained_with is not None and options.items() <= policy.config.trained_with.items()


def test_mean_and_deviation_bound_the_unit() -> None:
    statistics = {"mean": np.array([1.0, -2.0]), "std": np.array([0.5, 4.0])}
    low, high = bounds(statistics, NormalizationMode.MEAN_STD, 2)
    assert low.tolist() == [0.5, -6] and high.tolist() == [1.5, 2]
    with pytest.raises(ValueError, match="MEAN_STD needs the statistics std"):
        bounds({"mean": np.zeros(2)}, NormalizationMode.MEAN_STD, 2)
