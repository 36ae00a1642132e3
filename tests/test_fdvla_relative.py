"""`fdvla` with relative actions, and its temporal ensemble."""

import copy
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest
import torch
from fdvla_cases import make_batch, make_config, make_policy
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.rtc import RTCConfig
from relative_cases import make_dataset
from torch import Tensor

from lerobot_bomb.data.columns import read_columns
from lerobot_bomb.flag_errors import FlagError
from lerobot_policy_bomb.fdvla.modeling_fdvla import FdvlaPolicy

REACH = 0.1  # of an action from the state, where states wander over several units
CHUNK = 4
BEFORE = Path(__file__).parent / "fixtures" / "before_layout" / "fdvla"


@pytest.fixture(scope="module")
def meta(tmp_path_factory: pytest.TempPathFactory) -> LeRobotDatasetMetadata:
    return make_dataset(tmp_path_factory.mktemp("relative") / "data", REACH)


def build(meta: LeRobotDatasetMetadata | None, **options: Any) -> FdvlaPolicy:
    torch.manual_seed(0)
    return FdvlaPolicy(make_config(**{"relative_actions": True, **options}), dataset_meta=meta).eval()


def batch_of(policy: FdvlaPolicy, meta: LeRobotDatasetMetadata, frames: list[int]) -> dict[str, Any]:
    """Preprocessed chunks that start at these frames, with made-up images."""
    columns = read_columns(meta, ("action", "observation.state"))
    starts = np.array(frames)[:, None] + np.arange(CHUNK)
    raw: dict[str, Any] = {
        "observation.state": torch.from_numpy(columns["observation.state"][frames]),
        "action": torch.from_numpy(columns["action"][starts]),
        "action_is_pad": torch.zeros(starts.shape, dtype=torch.bool),
        "task": ["push"] * len(frames),
    }
    generator = torch.Generator().manual_seed(0)
    raw |= {key: torch.rand(len(frames), 3, 64, 64, generator=generator) for key in policy._cameras}
    preprocessor, _ = make_pre_post_processors(policy.config, dataset_stats=meta.stats)  # pyright: ignore
    return preprocessor(raw)


def test_what_the_heads_learn_is_the_difference_to_the_state_and_comes_back(
    meta: LeRobotDatasetMetadata,
) -> None:
    policy = build(meta)
    batch = batch_of(policy, meta, [0, 10, 40])
    relative = policy._actions(batch)
    columns = read_columns(meta, ("action", "observation.state"))
    for row, frame in enumerate([0, 10, 40]):
        residuals = columns["action"][frame : frame + CHUNK] - columns["observation.state"][frame]
        torch.testing.assert_close(
            relative[row] * policy._unit, torch.from_numpy(residuals), rtol=0, atol=1e-5
        )
    torch.testing.assert_close(policy.to_absolute(relative, batch), batch["action"], rtol=0, atol=1e-6)


def test_differences_have_the_spread_of_the_noise(meta: LeRobotDatasetMetadata) -> None:
    policy = build(meta)
    inside = [frame for frame in range(60) if frame % 30 <= 30 - CHUNK]
    relative = policy._actions(batch_of(policy, meta, inside))
    rms = relative.square().mean(dim=(0, 1)).sqrt()
    # whole chunks only; the fit has the starts of those that an episode's end cuts off too
    torch.testing.assert_close(rms, torch.ones(4), rtol=0, atol=0.05)


def test_actions_come_out_absolute_whatever_is_sampled(
    meta: LeRobotDatasetMetadata, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = build(meta)
    batch = batch_of(policy, meta, [5, 50])
    monkeypatch.setattr(policy, "_denoise", lambda _, noise, __: torch.zeros_like(noise))  # stay
    _, postprocessor = make_pre_post_processors(policy.config, dataset_stats=meta.stats)  # pyright: ignore
    actions = postprocessor(policy.predict_action_chunk(batch))
    states = torch.from_numpy(read_columns(meta, ("observation.state",))["observation.state"][[5, 50]])
    torch.testing.assert_close(actions, states[:, None].expand(-1, CHUNK, -1), rtol=0, atol=1e-5)


def test_learned_chunks_come_back_as_the_absolute_actions_they_were(meta: LeRobotDatasetMetadata) -> None:
    policy = build(meta, num_inference_steps=10)
    batch = batch_of(policy, meta, [0, 40])
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=2e-3, weight_decay=0.0)
    for step in range(400):
        loss, metrics = policy.train()(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 25 == 24:
            policy.eval().reset()
            error = (policy.predict_action_chunk(batch) - batch["action"]).abs().mean()
            if error < 0.1:
                assert metrics["l1"] < 0.5  # in the data's units
                return
    pytest.fail(f"not learned in 400 steps; loss {float(loss)}, error {float(error)}")


def test_excluded_dimensions_stay_absolute(meta: LeRobotDatasetMetadata) -> None:
    policy = build(meta, relative_exclude_joints=["grip", "y"])
    batch = batch_of(policy, meta, [0, 40])
    relative = policy._actions(batch)
    assert torch.equal(relative[..., [1, 3]], batch["action"][..., [1, 3]])
    assert not torch.isclose(relative[..., [0, 2]], batch["action"][..., [0, 2]]).any()
    assert policy.config.action_names == ["x", "y", "z", "grip"]


def test_a_checkpoint_keeps_its_scale_and_new_data_replace_it(
    meta: LeRobotDatasetMetadata, tmp_path: Path
) -> None:
    policy = build(meta)
    policy.save_pretrained(tmp_path / "checkpoint")
    loaded = FdvlaPolicy.from_pretrained(tmp_path / "checkpoint")
    batch = batch_of(policy, meta, [0, 40])
    assert torch.equal(loaded.predict_action_chunk(batch), policy.predict_action_chunk(batch))
    wider = make_dataset(tmp_path / "wider", 0.9)
    tuned = FdvlaPolicy.from_pretrained(tmp_path / "checkpoint", dataset_meta=wider)
    fresh = build(wider)
    assert policy.relative is not None and loaded.relative is not None
    assert tuned.relative is not None and fresh.relative is not None
    assert torch.equal(loaded.relative.scale, policy.relative.scale)
    assert torch.equal(tuned.relative.scale, fresh.relative.scale)
    assert not torch.equal(tuned.relative.scale, policy.relative.scale)


def test_what_is_relative_cannot_be_changed_in_evaluation(
    meta: LeRobotDatasetMetadata, tmp_path: Path
) -> None:
    build(meta).save_pretrained(tmp_path)
    for flag, message in (
        (
            '--relative_exclude_joints=["grip"]',
            r"--policy\.relative_exclude_joints=\['grip'\]: this checkpoint",
        ),
        (
            "--relative_actions=false",
            r"--policy\.relative_actions=False: this checkpoint was trained with True",
        ),
    ):
        config: Any = PreTrainedConfig.from_pretrained(tmp_path, cli_overrides=[flag])
        with pytest.raises(ValueError, match=message):
            FdvlaPolicy.from_pretrained(tmp_path, config=config)


def test_a_checkpoint_of_before_has_absolute_actions_and_cannot_get_others() -> None:
    stored: Any = PreTrainedConfig.from_pretrained(BEFORE)
    assert not stored.relative_actions and stored.temporal_ensemble_size == 0
    assert "relative_actions" not in json.loads((BEFORE / "config.json").read_text())
    config: Any = PreTrainedConfig.from_pretrained(BEFORE, cli_overrides=["--relative_actions=true"])
    with pytest.raises(
        ValueError, match=r"--policy.relative_actions is not what this checkpoint was trained"
    ):
        FdvlaPolicy.from_pretrained(BEFORE, config=config)


def test_delta_control_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"relative_actions=true: action dimension 0 does not follow"):
        build(make_dataset(tmp_path / "data", REACH, delta=True))


def test_relative_actions_need_the_state() -> None:
    with pytest.raises(
        ValueError, match=r"--policy.relative_actions=true needs the feature 'observation.stat"
    ):
        make_policy(relative_actions=True, has_state=False, use_state=False)


def test_real_time_chunking_goes_on_from_the_absolute_actions_that_are_left(
    meta: LeRobotDatasetMetadata,
) -> None:
    policy = build(meta, num_inference_steps=10)
    batch = batch_of(policy, meta, [0])
    noise = torch.randn(1, CHUNK, 4, generator=torch.Generator().manual_seed(0))
    left = batch["action"] + 0.05
    free = policy.predict_action_chunk(batch, noise)
    policy.config.rtc_config = RTCConfig(execution_horizon=CHUNK)
    policy.init_rtc_processor()
    options = {"inference_delay": CHUNK, "prev_chunk_left_over": left[0]}
    following = policy.predict_action_chunk(batch, noise, **options)
    assert (following - left).abs().mean() < 0.1 * (free - left).abs().mean()
    padded = {**options, "prev_chunk_left_over": torch.cat([left[0], torch.zeros(3, 4)])}
    assert torch.equal(policy.predict_action_chunk(batch, noise, **padded), following)


# Temporal ensemble


def foreseen(policy: FdvlaPolicy) -> tuple[list[dict[str, Any]], list[Tensor]]:
    """Return three observations, and the chunk of each."""
    batches = [make_batch(policy, 2, seed=seed) for seed in range(3)]
    policy.reset()
    chunks = [policy.predict_action_chunk(batch) for batch in batches]
    policy.reset()
    return batches, chunks


@pytest.mark.parametrize("is_relative", [False, True])
def test_an_ensemble_is_the_mean_of_what_chunks_foresaw_as_in_act(is_relative: bool) -> None:
    options: dict[str, Any] = {"temporal_ensemble_size": 2, "n_action_steps": 1}
    policy = make_policy(
        **options,
        relative_actions=is_relative,
        action_feature_names=["x", "y", "z", "grip"],
        temporal_ensemble_exclude_joints=["grip"],
    )
    batches, chunks = foreseen(policy)
    actions = [policy.select_action(batch) for batch in batches]
    assert torch.equal(actions[0], chunks[0][:, 0])
    newest = 1 / (1 + math.exp(0.01))
    for step in (1, 2):
        mean = newest * chunks[step][:, 0] + (1 - newest) * chunks[step - 1][:, 1]
        torch.testing.assert_close(actions[step][:, :3], mean[:, :3])
        assert torch.equal(actions[step][:, 3], chunks[step][:, 0, 3])
    policy.reset()
    assert torch.equal(policy.select_action(batches[0]), chunks[0][:, 0])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"temporal_ensemble_size": 2}, "needs --policy.n_action_steps=1; got 2"),
        ({"temporal_ensemble_size": 9, "n_action_steps": 1}, r"must be 0 \(no ensemble\) or lie in 1..4"),
        ({"temporal_ensemble_weighting": "newest"}, "temporal_ensemble_weighting='newest' is unknown"),
    ],
)
def test_ensembles_that_do_not_fit(options: dict[str, Any], message: str) -> None:
    with pytest.raises(FlagError, match=message):
        make_config(**options)


def test_an_instruction_beyond_the_positions_is_refused_before_training(meta: LeRobotDatasetMetadata) -> None:
    long = copy.copy(meta)
    long.tasks = pandas.DataFrame({"task_index": [0]}, index=pandas.Index(["put the " * 2100]))
    with pytest.raises(
        ValueError, match=r"model has 4096 positions; shorten the dataset's instruction 'put the"
    ):
        build(long)
