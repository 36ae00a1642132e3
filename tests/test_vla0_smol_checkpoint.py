import copy
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pandas
import pytest
import torch
from accelerate import FullyShardedDataParallelPlugin
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies.factory import make_pre_post_processors
from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS
from relative_cases import make_dataset
from safetensors.torch import load_file, save_file
from tokenizers import Tokenizer
from torch import Tensor
from vla0_smol_cases import (
    STATS,
    WRIST,
    make_batch,
    make_config,
    make_policy,
    raw_batch,
)

from lerobot_bomb.flag_errors import FlagError
from lerobot_bomb.vlm import task_tokenizer
from lerobot_bomb.vlm.prompt import task_ids
from lerobot_policy_bomb.vla0_smol import make_vla0_smol_pre_post_processors
from lerobot_policy_bomb.vla0_smol.modeling_vla0_smol import Vla0SmolPolicy


@pytest.fixture(scope="module")
def meta(tmp_path_factory: pytest.TempPathFactory) -> LeRobotDatasetMetadata:
    """Make a dataset that a policy is made for."""
    return make_dataset(tmp_path_factory.mktemp("data") / "small", 0.1)


# Checkpoints


def save(policy: Vla0SmolPolicy, folder: Path) -> None:
    policy.save_pretrained(folder)
    for pipeline in make_vla0_smol_pre_post_processors(policy.config, STATS):
        pipeline.save_pretrained(folder)


def test_a_saved_policy_acts_the_same(tmp_path: Path) -> None:
    policy = make_policy()
    batch = make_batch(policy, 4)
    save(policy, tmp_path)
    loaded = Vla0SmolPolicy.from_pretrained(tmp_path)
    assert not loaded.training
    assert torch.equal(loaded.predict_action_chunk(batch), policy.predict_action_chunk(batch))
    assert loaded.config.vlm_config == policy.config.vlm_config
    preprocessor, postprocessor = make_pre_post_processors(loaded.config, str(tmp_path))
    again = preprocessor(raw_batch(4))
    for key, value in batch.items():
        if isinstance(value, Tensor):
            assert torch.equal(again[key], value), key
    actions = torch.tensor([[0.5, -0.5, 0.0, 1.0]])
    torch.testing.assert_close(postprocessor(actions), actions)


def test_the_four_steps_that_lerobot_overrides_are_there() -> None:
    pipelines = make_vla0_smol_pre_post_processors(make_config(), STATS)
    names = [[step["registry_name"] for step in pipeline.get_config()["steps"]] for pipeline in pipelines]
    assert names == [
        [
            "rename_observations_processor",
            "to_batch_processor",
            "bomb_task_tokenizer",
            "device_processor",
            "normalizer_processor",
        ],
        ["unnormalizer_processor", "device_processor"],
    ]


def test_a_task_is_tokenized_once_and_what_is_kept_is_not_saved(monkeypatch: pytest.MonkeyPatch) -> None:
    tokenized: list[str] = []

    def count(tokenizer: Tokenizer, task: str, template: str) -> list[int]:
        tokenized.append(task)
        return task_ids(tokenizer, task, template)

    monkeypatch.setattr(task_tokenizer, "task_ids", count)
    monkeypatch.setattr(task_tokenizer, "MAX_KEPT_TASKS", 3)
    preprocessor, _ = make_vla0_smol_pre_post_processors(make_config(), STATS)
    step = preprocessor.steps[2]
    before = step.get_config(), step.state_dict()
    first, again = preprocessor(raw_batch(3)), preprocessor(raw_batch(3))
    assert tokenized == raw_batch(3)["task"]
    assert torch.equal(first[OBS_LANGUAGE_TOKENS], again[OBS_LANGUAGE_TOKENS])
    preprocessor(raw_batch(5))
    assert len(tokenized) == 5  # two more tasks displace those that were kept
    assert (before[0], before[1].keys()) == (step.get_config(), step.state_dict().keys())
    preprocessor(raw_batch(1))
    step.load_state_dict(step.state_dict())  # another tokenizer may write another sequence
    preprocessor(raw_batch(1))
    assert tokenized[5:] == 2 * raw_batch(1)["task"]


def test_a_missing_or_unexpected_tensor_is_an_error(tmp_path: Path) -> None:
    make_policy().save_pretrained(tmp_path)
    weights = load_file(tmp_path / "model.safetensors")
    head = weights.pop("backbone.vlm.lm_head.weight")
    save_file(weights, tmp_path / "model.safetensors")
    with pytest.raises(ValueError, match=r"lacks .*lm_head\.weight"):
        Vla0SmolPolicy.from_pretrained(tmp_path)
    weights |= {"backbone.vlm.lm_head.weight": head, "extra": head.clone()}
    save_file(weights, tmp_path / "model.safetensors")
    with pytest.raises(ValueError, match="has extra"):
        Vla0SmolPolicy.from_pretrained(tmp_path)


LOAD = """
import sys
from lerobot_bomb.explain.interventions import BlankImages, intervene
assert "lerobot_policy_bomb" not in sys.modules
intervene(sys.argv[1], [BlankImages()], sys.argv[1] + "_blank")  # registers the type of what it loads
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
import lerobot_policy_bomb
config = PreTrainedConfig.from_pretrained(sys.argv[1])
policy = get_policy_class(config.type).from_pretrained(sys.argv[1], config=config)
preprocessor, postprocessor = make_pre_post_processors(config, sys.argv[1])
batch = torch.load(sys.argv[2])
torch.save(postprocessor(policy.select_action(preprocessor(batch))), sys.argv[3])
"""


def test_a_checkpoint_needs_nothing_but_itself(tmp_path: Path) -> None:
    """Load, and change, in another process without network, with an empty Hub cache and no base model."""
    policy = make_policy(nano_config=None)  # which changes nano alone
    batch = make_batch(policy, 4)
    save(policy, tmp_path / "model")
    config_file = tmp_path / "model" / "config.json"
    stored = json.loads(config_file.read_text())
    config_file.write_text(json.dumps({**stored, "vlm_model_name": "nobody/has-this"}))
    torch.save(raw_batch(4), tmp_path / "batch.pt")
    subprocess.run(
        [sys.executable, "-c", LOAD, tmp_path / "model", tmp_path / "batch.pt", tmp_path / "action.pt"],
        env={**os.environ, "HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "empty")},
        check=True,
    )
    expected = policy.predict_action_chunk(batch)[:, 0]
    assert torch.equal(torch.load(tmp_path / "action.pt"), expected)
    assert (tmp_path / "model_blank" / "model.safetensors").exists()


def test_a_checkpoint_keeps_its_system_prompt(tmp_path: Path) -> None:
    policy = make_policy(system_prompt="Be precise.")
    save(policy, tmp_path)
    loaded = Vla0SmolPolicy.from_pretrained(tmp_path)
    batch = make_batch(policy, 2)
    assert torch.equal(loaded.prompt(batch).ids, policy.prompt(batch).ids)
    loaded.config.system_prompt = "Be quick."
    with pytest.raises(
        ValueError, match=r"--policy.system_prompt='Be quick.': .* trained with 'Be precise.'"
    ):
        Vla0SmolPolicy.from_pretrained(tmp_path, config=loaded.config)


@pytest.mark.parametrize(
    ("option", "value", "then"),
    [("n_action_bins", 100, 512), ("chunk_size", 4, 3), ("bin_mode", "levels", "'centers'")],
)
def test_what_a_checkpoint_was_trained_with_cannot_be_changed_in_evaluation(
    option: str, value: Any, then: Any, tmp_path: Path
) -> None:
    make_policy().save_pretrained(tmp_path)
    config: Any = PreTrainedConfig.from_pretrained(tmp_path, cli_overrides=[f"--{option}={value}"])
    message = rf"--policy.{option}={value!r}: this checkpoint was trained with {then}, which only another"
    with pytest.raises(ValueError, match=message):
        Vla0SmolPolicy.from_pretrained(tmp_path, config=config)


def test_config_survives_as_json(tmp_path: Path) -> None:
    policy = make_policy(number_width=4, image_size=128)
    policy.config._save_pretrained(tmp_path)
    assert PreTrainedConfig.from_pretrained(tmp_path) == policy.config
    flag = "--color_jitter=[0.2, 0.2, 0.2, 0.05]"
    config: Any = PreTrainedConfig.from_pretrained(tmp_path, cli_overrides=[flag])
    assert config.color_jitter == [0.2, 0.2, 0.2, 0.05]


# Processors


def test_a_constant_dimension_keeps_its_value() -> None:
    """LeRobot maps it to -1, whose lowest bin it shares, and back to the constant."""
    config = make_config()
    stats = copy.deepcopy(STATS)
    stats["action"]["min"][2] = stats["action"]["max"][2] = 0.25
    policy = Vla0SmolPolicy(config)
    preprocessor, postprocessor = make_vla0_smol_pre_post_processors(config, stats)
    raw = raw_batch(2)
    raw["action"][..., 2] = 0.25
    bins = policy.action_bins.encode(preprocessor(raw)["action"])
    assert torch.equal(bins[..., 2], torch.zeros(2, 3, dtype=torch.int64))
    action = postprocessor(policy.action_bins.decode(bins)[:, 0])
    torch.testing.assert_close(action[:, 2], torch.full((2,), 0.25))


@pytest.mark.parametrize("task", [None, [], [3]])
def test_an_observation_without_a_task_is_an_error(task: Any) -> None:
    preprocessor, _ = make_vla0_smol_pre_post_processors(make_config(), STATS)
    with pytest.raises(ValueError, match="needs the instruction under the key 'task'"):
        preprocessor({**raw_batch(1), "task": task})


# Config


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"chunk_size": 3, "n_action_steps": 5}, r"--policy.n_action_steps=5 must lie in 1..3"),
        ({"n_action_steps": 0}, r"--policy.n_action_steps=0 must lie in 1..3"),
        ({"chunk_size": 0}, r"--policy.chunk_size=0 must be at least 1"),
        ({"n_obs_steps": 2}, r"--policy.n_obs_steps=2"),
        ({"temporal_ensemble_size": 4}, r"--policy.temporal_ensemble_size=4 must be 0 .* or lie in 1..3"),
        (
            {"temporal_ensemble_size": 3, "n_action_steps": 2},
            r"--policy.temporal_ensemble_size=3 .* needs --policy.n_action_steps=1; got 2, which is a queue",
        ),
        ({"temporal_ensemble_weighting": "newest"}, r"--policy.temporal_ensemble_weighting='newest' is unk"),
        ({"draft": "previous"}, r"--policy.draft='previous' is unknown; choose one of: none, linear"),
        ({"n_action_bins": 10_001}, r"--policy.n_action_bins=10001 must lie in 2..10000"),
        ({"number_width": 5}, r"--policy.number_width=5 must be 0 \(no padding\) or lie in 3..4"),
        (
            {"temporal_ensemble_coefficient": float("nan")},
            r"temporal_ensemble_coefficient=nan must be finite",
        ),
        ({"n_action_bins": 1}, r"--policy.n_action_bins=1 must lie in 2.."),
        ({"n_state_bins": -5}, r"--policy.n_state_bins=-5 must lie in 2.."),
        ({"number_width": 2}, r"--policy.number_width=2 must be 0 \(no padding\) or lie in 3.."),
        ({"number_width": -1}, r"--policy.number_width=-1"),
        ({"bin_mode": "round"}, r"--policy.bin_mode='round' is unknown; choose one of: centers, levels"),
        ({"mask_level": "word"}, r"--policy.mask_level='word' is unknown"),
        ({"mask_max_fraction": 1.5}, r"--policy.mask_max_fraction=1.5 must lie in 0..1"),
        ({"mask_skip_prob": -0.1}, r"--policy.mask_skip_prob=-0.1 must lie in 0..1"),
        (
            {"color_jitter": [0.2, 0.2, 0.2]},
            r"--policy.color_jitter=\[0.2, 0.2, 0.2\] must be four numbers: .* VLA-0's are \[0.2",
        ),
        ({"color_jitter": [0.2, 0.2, 0.2, 0.6]}, r"color_jitter=.* hue in 0..0.5"),
        ({"color_jitter": [-0.1, 0.2, 0.2, 0.0]}, r"color_jitter=.* brightness, .* in 0..1"),
        ({"color_jitter": [float("nan"), 0.2, 0.2, 0.0]}, r"color_jitter=\[nan"),
        ({"image_size": 0}, r"--policy.image_size=0 must be at least 1"),
        ({"crop_fraction": 0.0}, r"--policy.crop_fraction=0.0 must lie in \(0, 1\]"),
        ({"dtype": "float16"}, r"--policy.dtype='float16' is unknown; choose one of: float32, bfloat16"),
        ({"use_amp": True, "dtype": "bfloat16"}, r"--policy.use_amp=true .* --policy.dtype=bfloat16 instead"),
        ({"vlm_model_name": ""}, r"--policy.vlm_model_name is empty"),
        ({"drop_n_last_frames": -1}, r"--policy.drop_n_last_frames=-1"),
        ({"scheduler_decay_steps": 0}, r"--policy.scheduler_decay_steps=0"),
        ({"optimizer_lr": -1.0}, r"--policy.optimizer_lr=-1.0"),
        (
            {
                "normalization_mapping": {
                    "VISUAL": NormalizationMode.IDENTITY,
                    "STATE": NormalizationMode.MEAN_STD,
                }
            },
            r"--policy.normalization_mapping\[STATE\]",
        ),
    ],
)
def test_bad_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(FlagError, match=message):
        make_config(**options)


@pytest.mark.parametrize(
    ("options", "way_out"),
    [
        ({"mask_level": "step"}, r"of the 3 that --policy.mask_level=step may .* more than 1/3 = 0.333"),
        ({"chunk_size": 1, "n_action_steps": 1}, r"of the 4 that --policy.mask_level=value .* 1/4 = 0.25"),
        (
            {"mask_max_fraction": 0.05},
            r"mask_max_fraction=0.05: of the 12 .* 1/12 = 0.0833, or 0 to hide nothing",
        ),
        (
            {"mask_level": "step", "chunk_size": 1, "n_action_steps": 1, "mask_max_fraction": 1.0},
            r"give --policy.mask_level=value, or 0",
        ),
    ],
)
def test_masking_that_never_hides_anything_is_refused_before_training(
    options: dict[str, Any], way_out: str, meta: LeRobotDatasetMetadata
) -> None:
    with pytest.raises(ValueError, match=way_out):
        Vla0SmolPolicy(make_config(**options), meta)
    # a checkpoint that was trained so still acts
    Vla0SmolPolicy(make_config(**options))


@pytest.mark.parametrize(
    "options",
    [{"mask_level": "step", "mask_max_fraction": 0.34}, {"mask_max_fraction": 0.0}, {"mask_skip_prob": 1.0}],
)
def test_masking_that_may_hide_something_or_nothing_on_purpose_is_taken(options: dict[str, Any]) -> None:
    config = make_config(**options)
    config.check_masking()
    kept = Vla0SmolPolicy(config)._draw_hidden(torch.ones(500, 3, dtype=torch.bool)).any()
    assert kept == (options == {"mask_level": "step", "mask_max_fraction": 0.34})


@pytest.mark.parametrize(("num_words", "is_refused"), [(700, False), (2000, True), (500_000, True)])
def test_an_instruction_beyond_the_positions_is_refused_before_training(
    num_words: int, is_refused: bool, meta: LeRobotDatasetMetadata
) -> None:
    """The words are 8 bytes and 2 tokens: 700 of them have more bytes than there are positions."""
    long = copy.copy(meta)
    long.tasks = pandas.DataFrame({"task_index": [0]}, index=pandas.Index(["put the " * num_words]))
    if not is_refused:
        Vla0SmolPolicy(make_config(), long)
        return
    with pytest.raises(
        ValueError, match=r"model has 4096 positions; shorten the dataset's instruction 'put the"
    ):
        Vla0SmolPolicy(make_config(), long)


def test_an_instruction_beyond_the_positions_is_not_trained_on() -> None:
    """Check the sequence itself, where nothing has looked before: there is no dataset."""
    policy = make_policy().train()
    batch = make_batch(policy, 2)
    batch[OBS_LANGUAGE_TOKENS] = torch.zeros(2, 4100, dtype=torch.int64)
    batch[OBS_LANGUAGE_ATTENTION_MASK] = torch.ones(2, 4100, dtype=torch.bool)
    with pytest.raises(ValueError, match="4096 positions; shorten the instruction or give a smaller"):
        policy(batch)


STATE_FEATURE = {"observation.state": PolicyFeature(FeatureType.STATE, (4,))}
IMAGE_FEATURE = {WRIST: PolicyFeature(FeatureType.VISUAL, (3, 64, 64))}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"input_features": STATE_FEATURE}, "needs at least one camera; .*'observation.state'"),
        ({"input_features": IMAGE_FEATURE}, "--policy.use_state=true needs .* Give --policy.use_state=false"),
        (
            {"input_features": IMAGE_FEATURE, "use_state": False, "relative_actions": True},
            "--policy.relative_actions=true needs .* Give --policy.relative_actions=false",
        ),
        (  # LIBERO: 8 numbers of state, 7 of action
            {
                "relative_actions": True,
                "input_features": {
                    **IMAGE_FEATURE,
                    "observation.state": PolicyFeature(FeatureType.STATE, (8,)),
                },
                "output_features": {"action": PolicyFeature(FeatureType.ACTION, (7,))},
            },
            "7 of 7 action dimensions are relative and the state has 8; give --policy.relative_state_indices",
        ),
        ({"output_features": {}}, "needs the feature 'action'"),
        (
            {"input_features": {**STATE_FEATURE, WRIST: PolicyFeature(FeatureType.VISUAL, (1, 64, 64))}},
            r"camera 'observation.images.wrist' has shape \(1, 64, 64\)",
        ),
    ],
)
def test_features_that_do_not_fit_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Vla0SmolPolicy(make_config(**options))


def test_a_hub_model_without_network_is_refused_with_both_ways_out() -> None:
    with pytest.raises(OSError, match=r"--policy.vlm_model_name=nobody/has-this: .*=nano .*local folder"):
        make_policy(vlm_model_name="nobody/has-this")


@pytest.mark.parametrize("name", ["/nowhere/base", "./base", "outputs/base/backbone"])
def test_a_folder_that_is_missing_is_not_looked_for_on_the_hub(name: str) -> None:
    with pytest.raises(OSError, match=f"--policy.vlm_model_name={re.escape(name)}: there is no such folder"):
        make_policy(vlm_model_name=name)


def test_training_presets() -> None:
    config = make_config()
    optimizer, scheduler = config.get_optimizer_preset(), config.get_scheduler_preset()
    assert (optimizer.lr, optimizer.betas, optimizer.grad_clip_norm) == (5e-5, (0.9, 0.95), 1.0)
    assert (scheduler.num_warmup_steps, scheduler.num_decay_steps, scheduler.decay_lr) == (1000, 30000, 5e-6)
    assert config.action_delta_indices == [0, 1, 2]
    assert config.push_to_hub is False


# Sharding


def test_fsdp_shards_the_layers_of_both_models() -> None:
    policy = make_policy()
    plugin = FullyShardedDataParallelPlugin(auto_wrap_policy="transformer_based_wrap")
    plugin.set_auto_wrap_policy(policy)
    wraps: Any = plugin.auto_wrap_policy
    sharded = [module for module in policy.modules() if wraps(module, recurse=False, nonwrapped_numel=0)]
    layers: Any = policy.backbone.vlm.config
    assert len(sharded) == layers.text_config.num_hidden_layers + layers.vision_config.num_hidden_layers
