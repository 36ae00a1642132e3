"""`--policy.nano_config`: nano with fewer layers or image tokens, of every policy."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from policy_cases import CASES

from lerobot_bomb.flag_errors import FlagError
from lerobot_bomb.training.policy_flags import check_as_trained, check_weights_fit
from lerobot_bomb.vlm.presets import changed

PRESET: dict[str, Any] = {"scale_factor": 2, "image_token_id": 7, "text_config": {"layers": 4, "width": 128}}
ACTION: dict[str, Any] = {"dtype": "float32", "shape": (4,), "names": None}
META: Any = SimpleNamespace(features={"action": ACTION})  # of a dataset to train on
TWO_LAYERS = {"text_config": {"num_hidden_layers": 2}}


def test_a_change_is_of_one_value() -> None:
    assert changed(PRESET, None) == changed(PRESET, {}) == PRESET
    assert changed(PRESET, {"text_config": {"layers": 2}, "scale_factor": 4}) == {
        "scale_factor": 4,
        "image_token_id": 7,
        "text_config": {"layers": 2, "width": 128},
    }
    assert PRESET["text_config"]["layers"] == 4


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"layers": 2}, "nano_config: 'layers' cannot be changed; choose scale_factor, text_config"),
        ({"image_token_id": 2}, "nano_config: 'image_token_id' cannot be changed; choose scale_factor"),
        ({"text_config": {"depth": 2}}, "nano_config, text_config: 'depth' .*; choose layers, width"),
        ({"text_config": 2}, "nano_config: text_config=2 must be as in the preset, {'layers'"),
        ({"scale_factor": {}}, "nano_config: scale_factor={} must be as in the preset, 2"),
    ],
)
def test_what_there_is_not_to_change(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"--policy.{message}"):
        changed(PRESET, changes)


def test_a_policy_is_built_and_kept_so(policy_type: str, tmp_path: Path) -> None:
    cases = CASES[policy_type]
    policy = cases.make_policy(nano_config=TWO_LAYERS)
    assert policy.config.vlm_config["text_config"]["num_hidden_layers"] == 2
    num_parameters, num_of_preset = (
        sum(parameter.numel() for parameter in each.parameters())
        for each in (policy, cases.make_policy(nano_config=None))
    )
    assert num_parameters < num_of_preset
    policy.save_pretrained(tmp_path)
    loaded = type(policy).from_pretrained(tmp_path)
    batch = cases.make_batch(policy, 2)
    torch.testing.assert_close(loaded.predict_action_chunk(batch), policy.predict_action_chunk(batch))

    config: Any = PreTrainedConfig.from_pretrained(tmp_path)
    config.nano_config = None
    with pytest.raises(ValueError, match=r"--policy.nano_config=None: this checkpoint was trained with"):
        type(policy).from_pretrained(tmp_path, config=config)
    with pytest.raises(ValueError, match=r"--policy.nano_config=None: the weights of this checkpoint"):
        type(policy).from_pretrained(tmp_path, config=config, dataset_meta=META)


def test_only_nano_is_changed(policy_type: str) -> None:
    with pytest.raises(FlagError, match=r"--policy.nano_config=.* changes .*=nano, not HuggingFaceTB/x"):
        replace(CASES[policy_type].make_config(nano_config=TWO_LAYERS), vlm_model_name="HuggingFaceTB/x")


def test_checkpoints_of_before_the_flag_are_read() -> None:
    config = CASES["vla0_smol"].make_config(nano_config=None)
    config.trained_with = {"chunk_size": 3}
    check_as_trained(config, ("nano_config",))
    check_weights_fit(config, ("nano_config",))
