"""Relative actions inside the policy: fitted to a dataset, saved, loaded, fitted anew."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import factory
from relative_cases import NAMES, make_dataset
from vla0_smol_cases import make_batch, make_config, make_policy

from lerobot_bomb.decoding.decoder import Decoded
from lerobot_policy_bomb.vla0_smol.modeling_vla0_smol import Vla0SmolPolicy


def build(meta: LeRobotDatasetMetadata | None, **options: Any) -> Vla0SmolPolicy:
    torch.manual_seed(0)
    config = make_config(**{"relative_actions": True, "chunk_size": 3, **options})
    return Vla0SmolPolicy(config, dataset_meta=meta).eval()


def test_written_numbers_are_the_residuals(tmp_path: Path) -> None:
    meta = make_dataset(tmp_path / "data", 0.1)
    policy = build(meta, n_action_bins=999, bin_mode="levels", action_feature_names=["x", "y", "z", "grip"])
    assert policy.relative is not None and meta.stats is not None
    action, state = (meta.stats[key] for key in ("action", "observation.state"))
    state_raw, action_raw = np.array([0.5, -0.5, 1.0, 0.0]), np.array([0.55, -0.6, 1.0, 0.2])
    normalise = lambda x, s: torch.from_numpy(2 * (x - s["min"]) / (s["max"] - s["min"]) - 1).float()  # noqa: E731
    batch = make_batch(policy, 1)
    batch["observation.state"] = normalise(state_raw, state)[None]
    batch["action"] = normalise(action_raw, action).expand(1, 3, 4)
    written = policy.action_bins.decode(policy._targets(batch)[0]).view(3, 4)[0]
    unit = policy.relative.scale.numpy() * (action["max"] - action["min"]) / 2
    np.testing.assert_allclose(
        written.numpy() * unit, (action_raw - state_raw).clip(-unit, unit), atol=unit.max() / 998
    )
    torch.testing.assert_close(policy._unit, torch.from_numpy(unit).float())


def test_actions_come_out_absolute_whatever_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = build(make_dataset(tmp_path / "data", 0.1), bin_mode="levels", n_action_bins=999)
    batch = make_batch(policy, 2)
    bins = torch.full((2, 12), 499)  # zero: stay
    decode = "lerobot_bomb.decoding.writer.decode_numbers"
    monkeypatch.setattr(decode, lambda *_, **__: Decoded(bins, num_passes=1))
    chunk = policy.predict_action_chunk(batch)
    assert policy.relative is not None
    anchor = (policy.relative.gain * batch["observation.state"] + policy.relative.bias).clamp(-1, 1)
    torch.testing.assert_close(chunk, anchor[:, None].expand(2, 3, 4))


def test_a_checkpoint_keeps_its_scale_and_new_data_replace_it(tmp_path: Path) -> None:
    policy = build(make_dataset(tmp_path / "data", 0.1))
    policy.save_pretrained(tmp_path / "checkpoint")
    loaded = Vla0SmolPolicy.from_pretrained(tmp_path / "checkpoint")
    batch = make_batch(policy, 2)
    assert torch.equal(loaded.predict_action_chunk(batch), policy.predict_action_chunk(batch))
    wider = make_dataset(tmp_path / "wider", 0.9)
    tuned = Vla0SmolPolicy.from_pretrained(tmp_path / "checkpoint", dataset_meta=wider)
    assert policy.relative is not None and tuned.relative is not None and loaded.relative is not None
    assert torch.equal(loaded.relative.scale, policy.relative.scale)
    fresh = build(wider)
    assert fresh.relative is not None
    assert torch.equal(tuned.relative.scale, fresh.relative.scale)
    assert not torch.equal(tuned.relative.scale, policy.relative.scale)


def test_what_is_relative_cannot_be_changed_in_evaluation(tmp_path: Path) -> None:
    build(make_dataset(tmp_path / "data", 0.1)).save_pretrained(tmp_path / "checkpoint")
    flags = ['--relative_exclude_joints=["grip"]']
    config: Any = PreTrainedConfig.from_pretrained(tmp_path / "checkpoint", cli_overrides=flags)
    with pytest.raises(ValueError, match=r"--policy\.relative_exclude_joints=\['grip'\]: this checkpoint"):
        Vla0SmolPolicy.from_pretrained(tmp_path / "checkpoint", config=config)


def test_another_training_may_change_what_numbers_mean(tmp_path: Path) -> None:
    policy = build(make_dataset(tmp_path / "data", 0.1))
    policy.save_pretrained(tmp_path / "checkpoint")
    flags = ["--n_action_bins=100"]
    config: Any = PreTrainedConfig.from_pretrained(tmp_path / "checkpoint", cli_overrides=flags)
    data = make_dataset(tmp_path / "other", 0.9)
    tuned = Vla0SmolPolicy.from_pretrained(tmp_path / "checkpoint", config=config, dataset_meta=data)
    tuned.save_pretrained(tmp_path / "tuned")
    stored: Any = PreTrainedConfig.from_pretrained(tmp_path / "tuned")
    assert stored.trained_with["n_action_bins"] == 100
    Vla0SmolPolicy.from_pretrained(tmp_path / "tuned", config=stored)


def test_a_checkpoint_without_relative_actions_cannot_get_them(tmp_path: Path) -> None:
    make_policy().save_pretrained(tmp_path)
    config = make_config(relative_actions=True)
    trained = make_policy().config
    config.vlm_config, config.prompt_tokens = trained.vlm_config, trained.prompt_tokens
    with pytest.raises(
        ValueError, match=r"--policy.relative_actions is not what this checkpoint was trained"
    ):
        Vla0SmolPolicy.from_pretrained(tmp_path, config=config)


def test_excluded_dimensions_stay_absolute(tmp_path: Path) -> None:
    meta = make_dataset(tmp_path / "data", 0.1)
    policy = build(meta, relative_exclude_joints=["grip", "y"])
    assert policy.relative is not None
    batch = make_batch(policy, 2)
    relative = policy.relative.encode(batch["action"], batch["observation.state"])
    assert torch.equal(relative[..., [1, 3]], batch["action"][..., [1, 3]])
    assert not torch.isclose(relative[..., [0, 2]], batch["action"][..., [0, 2]]).any()


def test_names_that_a_dataset_groups_are_found_by_lerobots_factory(tmp_path: Path) -> None:
    """Check names such as lerobot/pusht's, from scratch and from a checkpoint."""
    meta = make_dataset(tmp_path / "data", 0.1, names={"motors": NAMES})
    config = make_config(relative_actions=True, relative_exclude_joints=["grip"])
    for _ in range(2):
        policy = factory.make_policy(config, ds_meta=meta)
        assert isinstance(policy, Vla0SmolPolicy) and policy.relative is not None
        assert policy.config.action_names == NAMES
        assert policy.relative.state_of_dim == {0: 0, 1: 1, 2: 2}
        policy.save_pretrained(tmp_path / "checkpoint")
        config.pretrained_path = tmp_path / "checkpoint"


def test_the_scale_is_that_of_the_episodes_that_are_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Check a dataset on the Hub: LeRobot downloads the data files of --dataset.episodes; streamed, none."""
    here = build(make_dataset(tmp_path / "here", 0.1)).relative
    meta = make_dataset(tmp_path / "data", 0.1)
    file = meta.get_data_file_path(0)
    elsewhere = Path("data/chunk-000/file-001.parquet")
    monkeypatch.setattr(meta, "get_data_file_path", lambda episode: file if episode < 2 else elsewhere)
    meta.info.total_episodes = 3
    policy = build(meta)
    assert here is not None and policy.relative is not None
    assert torch.equal(policy.relative.scale, here.scale)
    (meta.root / file).unlink()
    with pytest.raises(
        ValueError,
        match=r"is fitted to all frames before training, but .* no data file of test/relative; .*streaming",
    ):
        build(meta)


def test_delta_control_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        ValueError, match=r"--policy.relative_actions=true: action dimension 0 does not follow"
    ):
        build(make_dataset(tmp_path / "data", 0.1, delta=True))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"relative_exclude_joints": ["grip"]}, "no action dimension is called 'grip'; there are 0, 1, 2, 3"),
        (
            {"relative_state_indices": [0, 1]},
            r"4 of 4 action dimensions are relative and the state has 4; give",
        ),
        ({"relative_state_indices": [0, 1, 2, 4]}, r"relative_state_indices=\[0, 1, 2, 4\] must lie in 0..3"),
    ],
)
def test_dimensions_that_do_not_fit_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_policy(relative_actions=True, **options)
