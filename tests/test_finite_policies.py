"""Nothing that is NaN or infinite goes into one of our policies or comes out of it."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import NormalizationMode
from lerobot.policies.factory import make_pre_post_processors
from policy_cases import CASES
from safetensors.torch import load_file, save_file
from torch import Tensor

from lerobot_bomb.actions.relative import RelativeActions, bounds
from lerobot_bomb.decoding.kv_cache import CachedText
from lerobot_bomb.vlm.backbone import load_backbone
from lerobot_policy_bomb.vla0_smol.modeling_vla0_smol import Vla0SmolPolicy

STATE, WRIST, ACTION = "observation.state", "observation.images.wrist", "action"
# a part of the model that every answer depends on
HEADS = {"vla0_smol": "lm_head", "spatialvla_grid": "cell_head", "fdvla": "flow_head"}


@pytest.fixture(scope="module")
def policies() -> dict[str, Any]:
    return {name: cases.make_policy(use_state=True) for name, cases in CASES.items()}


def spoil(values: Tensor, row: int, bad: float) -> Tensor:
    values = values.clone()
    values[row].view(-1)[-1] = bad
    return values


def statistics(bad: float = 1.0) -> dict[str, dict[str, Tensor]]:
    names = ("min", "max", "mean", "std", "q01", "q99")
    ends = {name: torch.full((4,), -1.0 if name == "min" else 1.0) for name in names}
    return {STATE: ends, ACTION: {**ends, "max": torch.tensor([1, 1, bad, 1])}}


def raw_batch(chunk_size: int) -> dict[str, Any]:
    return {
        WRIST: torch.rand(2, 3, 64, 64),
        "observation.images.workspace": torch.rand(2, 3, 64, 64),
        "observation.depth.wrist": torch.full((2, 64, 64), torch.nan),  # there is none
        STATE: torch.zeros(2, 4),
        ACTION: torch.zeros(2, chunk_size, 4),
        "task": ["go", "stay"],
        "index": torch.tensor([40, 51]),
        "episode_index": torch.tensor([3, 4]),
    }


@pytest.mark.parametrize("bad", [torch.nan, -torch.inf])
def test_a_batch_is_checked_before_it_is_normalised(
    policies: dict[str, Any], policy_type: str, bad: float
) -> None:
    config = policies[policy_type].config
    preprocessor, _ = make_pre_post_processors(config, dataset_stats=statistics())
    raw = raw_batch(config.chunk_size)
    preprocessor(raw)
    for key in (STATE, WRIST, ACTION):
        # the last action of the chunk, the frame's own image and state
        frame = 51 + (config.chunk_size - 1 if key == ACTION else 0)
        with pytest.raises(ValueError, match=rf"'{key}' is not finite in frame {frame} .* episode 4"):
            preprocessor({**raw, key: spoil(raw[key], 1, bad)})
    observation = {key: raw[key] for key in (STATE, WRIST, "observation.images.workspace", "task")}
    with pytest.raises(ValueError, match=rf"'{STATE}' is not finite in row 1 of the batch"):
        preprocessor({**observation, STATE: spoil(raw[STATE], 1, bad)})


def test_statistics_are_checked(policies: dict[str, Any], policy_type: str) -> None:
    config, cases = policies[policy_type].config, CASES[policy_type]
    message = r"statistics \(meta/stats.json\): max of 'action' is not finite: 1 of 4"
    with pytest.raises(ValueError, match=message):
        make_pre_post_processors(config, dataset_stats=statistics(torch.nan))
    feature = {"shape": (4,), "names": ["x", "y", "z", "g"]}
    meta = SimpleNamespace(stats=statistics(torch.nan), features={ACTION: feature, STATE: feature})
    with pytest.raises(ValueError, match=message):
        type(policies[policy_type])(cases.make_config(), dataset_meta=meta)


@pytest.mark.parametrize("key", [STATE, WRIST, ACTION])
def test_a_policy_alone_reads_nothing_that_is_not_finite(
    policies: dict[str, Any], policy_type: str, key: str
) -> None:
    policy = policies[policy_type]
    batch = CASES[policy_type].make_batch(policy, 2)
    batch[key] = spoil(batch[key], 1, torch.nan)
    with pytest.raises(ValueError, match=rf"'{key}' is not finite in row 1 of the batch"):
        policy(batch)
    if key != ACTION:
        policy.reset()
        with pytest.raises(ValueError, match=rf"'{key}' is not finite in row 1 of the batch"):
            policy.select_action(batch)


def test_a_model_that_diverged_neither_acts_nor_trains(policy_type: str) -> None:
    policy = CASES[policy_type].make_policy()
    batch = CASES[policy_type].make_batch(policy, 2)
    for name, weights in policy.named_parameters():
        if HEADS[policy_type] in name:
            torch.nn.init.constant_(weights, torch.nan)
    with pytest.raises(ValueError, match=r"NaN or infinite numbers for the rows \[0, 1\] of the batch"):
        policy.select_action(batch)
    policy.train()
    with pytest.raises(ValueError, match=r"the loss is not finite .* after 1 batches"):
        policy(batch)


def test_a_drafted_answer_is_checked_in_every_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    """A batch of 1, where `spatialvla_grid` reads several cells a pass; only the later ones are spoiled."""
    policy = CASES["spatialvla_grid"].make_policy()
    batch = CASES["spatialvla_grid"].make_batch(policy, 1)
    assert policy._decoder.drafted
    passes, usual = [], CachedText.__call__

    def call(self: CachedText, embeds: Tensor, *columns: Tensor) -> Tensor:
        passes.append(embeds.shape[1])
        return usual(self, embeds, *columns) * (1 if len(passes) == 1 else torch.nan)

    monkeypatch.setattr(CachedText, "__call__", call)
    with pytest.raises(ValueError, match=r"the rows \[0\] of the batch"):
        policy.choose(batch, 4)
    assert len(passes) == 2


def test_a_checkpoint_is_checked(policies: dict[str, Any], policy_type: str, tmp_path: Path) -> None:
    policy = policies[policy_type]
    policy.save_pretrained(tmp_path)
    preprocessor, _ = make_pre_post_processors(policy.config, dataset_stats=statistics())
    preprocessor.save_pretrained(tmp_path)
    load = type(policy).from_pretrained
    load(tmp_path)
    weights = load_file(tmp_path / "model.safetensors")
    name = next(key for key in weights if HEADS[policy_type] in key)
    save_file({**weights, name: spoil(weights[name], -1, torch.nan)}, tmp_path / "model.safetensors")
    with pytest.raises(ValueError, match=rf"model.safetensors: {name} is not finite: 1 of"):
        load(tmp_path)
    save_file(weights, tmp_path / "model.safetensors")
    (state,) = tmp_path.glob("*normalizer*.safetensors")
    values = load_file(state)
    save_file({**values, "action.max": values["action.max"] * torch.inf}, state)
    with pytest.raises(ValueError, match=r"normalizer_processor.safetensors: action.max is not finite: 4 of"):
        load(tmp_path)


def test_base_weights_are_checked(tmp_path: Path) -> None:
    policy: Vla0SmolPolicy = CASES["vla0_smol"].make_policy()
    model = policy.backbone.vlm
    model.save_pretrained(tmp_path)
    load_backbone(str(tmp_path))
    torch.nn.init.constant_(model.model.text_model.norm.weight, torch.nan)
    model.save_pretrained(tmp_path)
    with pytest.raises(ValueError, match=rf"--policy.vlm_model_name={tmp_path}: .*norm.weight is not finite"):
        load_backbone(str(tmp_path))


def test_relative_statistics_are_of_finite_frames() -> None:
    frames = np.linspace(-1, 1, 12).reshape(6, 2)
    spoiled = frames.copy()
    spoiled[[2, 4], 1] = np.nan
    ends, span = np.full(6, 6), (np.full(2, -1.0), np.full(2, 1.0))
    for actions, states, name in ((spoiled, frames, "actions"), (frames, spoiled, "states")):
        with pytest.raises(ValueError, match=rf"2 of 6 {name} are not finite, the first at index 2"):
            RelativeActions(2, {0: 0}).fit(actions, states, ends, 2, span, span)


def test_bounds_are_finite() -> None:
    with pytest.raises(ValueError, match=r"statistic max is not finite: 1 of 2 .* at \[1\]"):
        bounds({"min": np.zeros(2), "max": np.array([1, np.inf])}, NormalizationMode.MIN_MAX, 2)
