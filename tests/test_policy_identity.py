"""Policy that a record names: the one that this process built, or none."""

import gc
import hashlib
import json
import logging
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from huggingface_hub import constants
from lerobot.configs import PreTrainedConfig
from lerobot.policies import PreTrainedPolicy, make_policy
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.scripts import lerobot_train

import lerobot_policy_bomb  # noqa: F401  the plugin
from lerobot_bomb.checkpoints.acting import acting, acting_config, acting_policy
from lerobot_bomb.checkpoints.identity import _of_checkpoint, identity_of, identity_of_config
from lerobot_bomb.checkpoints.shipped import checkpoint_path
from lerobot_bomb.compat.hooks import evaluation
from lerobot_bomb.compat.hooks import policies as built
from lerobot_bomb.compat.hooks.policies import built_policies
from lerobot_bomb.results.bomb import EpisodeResult
from lerobot_bomb.results.groups import read_results
from lerobot_bomb.results.origin import PolicyIdentity
from lerobot_env_bomb.bomb.configuration_bomb import BombEnvConfig
from lerobot_policy_bomb.bomb_expert.configuration_bomb_expert import BombExpertConfig

ENV = BombEnvConfig(image_size=32, fps=1)


@pytest.fixture(autouse=True)
def no_policy_of_other_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(built, "_BUILT", [])


def act_config(**flags: Any) -> ACTConfig:
    small: dict[str, Any] = {"dim_model": 8, "n_heads": 1, "dim_feedforward": 8, "chunk_size": 4}
    small |= {"n_action_steps": 4, "device": "cpu", "pretrained_backbone_weights": None, "use_vae": False}
    return ACTConfig(**(small | flags))


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("act") / "pretrained_model"
    make_policy(act_config(), env_cfg=ENV).save_pretrained(folder)
    (folder / "policy_preprocessor.json").write_text("{}")
    gc.collect()
    return folder


def loaded(checkpoint: Path, **flags: Any) -> PreTrainedPolicy:
    config = act_config(**flags)
    config.pretrained_path = checkpoint
    return make_policy(config, env_cfg=ENV)


def identity(policy: PreTrainedPolicy) -> PolicyIdentity:
    """Return what a record says while this policy, which the process holds, acts."""
    assert acting_policy() is policy
    return identity_of(policy)


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize("use_async", [False, True])
def test_a_line_names_the_checkpoint_that_was_loaded_after_the_environments(
    use_async: bool, checkpoint: Path, tmp_path: Path
) -> None:
    results = tmp_path / "results.jsonl"
    config = BombEnvConfig(image_size=32, fps=1, task_ids=[12, 3], results_path=str(results))
    envs = config.create_envs(2, use_async)["place"][12]
    policy = loaded(checkpoint)
    envs.reset(seed=[0, 1])
    while not (ends := envs.step(np.zeros((2, 4), dtype=np.float32)))[2].all() and not ends[3].all():
        pass
    envs.close()
    records = read_results(results, EpisodeResult)
    assert len(records) == 2
    for record in records:
        assert record.policy is not None
        assert record.policy.type == policy.config.type == "act"
        assert record.policy.path == str(checkpoint)
        assert record.policy.weights_sha256 == sha256(checkpoint / "model.safetensors")
        assert record.task_ids == (12, 3)
        assert record.opengl_renderer and record.opengl_vendor and record.mujoco_version
        assert record.torch_version and record.lerobot_version


def test_flags_and_processors_are_part_of_who_acts_and_a_place_is_not(checkpoint: Path) -> None:
    seen = []
    for flags in ({}, {}, {"n_action_steps": 2}, {"push_to_hub": False, "repo_id": "me/x"}):
        seen.append(identity(loaded(checkpoint, **flags)))
    (checkpoint / "policy_preprocessor.json").write_text('{"steps": []}')
    seen.append(identity(loaded(checkpoint)))
    first, again, other_flag, other_place, other_processor = (who.settings_sha256 for who in seen)
    assert first == again == other_place
    assert len({first, other_flag, other_processor}) == 3
    assert len({who.weights_sha256 for who in seen}) == 1
    first, again, other_flag, other_place, other_processor = (who.config_sha256 for who in seen)
    assert first == again == other_place == other_processor != other_flag


def test_a_flag_that_a_release_added_leaves_who_acts_as_it_was() -> None:
    """The digest of lines that were written before there was a `task_template`."""
    folder = checkpoint_path("bomb:spatialvla_grid")
    config: Any = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path = folder
    before = "886e070da0113fc6e9ccc9126b09dc364ec14fbb49f95cbe1e19a4d0202cf7bf"
    assert identity_of_config(config).settings_sha256 == before
    config.trained_with = {**config.trained_with, "task_template": "{}"}  # as a policy that is built adds it
    assert identity_of_config(config).settings_sha256 == before
    config.task_template = "what to do to {}?"
    assert identity_of_config(config).settings_sha256 != before


def test_a_policy_in_training_does_not_claim_the_weights_it_started_from(
    checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = loaded(checkpoint)
    meta = SimpleNamespace()
    setattr(policy.config, "_runtime_dataset_meta", meta)  # noqa: B010  as make_policy does for a dataset
    monkeypatch.setattr(evaluation, "_STEPS", [])
    assert identity(policy) == PolicyIdentity("act", is_in_training=True)
    evaluation.note_training_steps()
    assert lerobot_train.get_step_identifier(7, 100) == "000007"
    at_step = PolicyIdentity("act", is_in_training=True, training_step=7)
    assert identity(policy) == at_step and at_step.describe() == "act (in training, step 7)"


def test_scripted_and_untrained_policies_have_a_type_only() -> None:
    assert identity(make_policy(BombExpertConfig(), env_cfg=ENV)) == PolicyIdentity("bomb_expert")
    assert identity(make_policy(act_config(), env_cfg=ENV)) == PolicyIdentity("act")


def test_of_two_policies_none_is_named(checkpoint: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert acting_policy() is None
    both = loaded(checkpoint), loaded(checkpoint)
    with caplog.at_level(logging.WARNING):
        assert acting_policy() is None
    assert "this process holds 2 of them (act, act)" in caplog.text
    assert acting_config() is None
    with acting(both[0].config):
        assert acting_config() is both[0].config


def test_a_dropped_policy_that_refers_to_itself_is_not_one_of_two(checkpoint: Path) -> None:
    assert acting_policy() is None
    gc.disable()
    try:
        dropped = loaded(checkpoint)
        setattr(dropped, "itself", [dropped])  # noqa: B010  a cycle, not a module of it
        del dropped
        assert len(built_policies()) == 1
        policy = loaded(checkpoint)
        assert identity(policy).path == str(checkpoint)
    finally:
        gc.enable()


def test_adapters_name_their_file_and_their_base(tmp_path: Path) -> None:
    (tmp_path / "adapter_model.safetensors").write_bytes(b"adapters")
    adapters = {"base_model_name_or_path": "me/base", "revision": "0123"}
    (tmp_path / "adapter_config.json").write_text(json.dumps(adapters))
    config = act_config(use_peft=True)
    config.pretrained_path = tmp_path
    who = _of_checkpoint(config)
    assert (who.base, who.weights_sha256) == ("me/base@0123", hashlib.sha256(b"adapters").hexdigest())


def test_a_checkpoint_on_the_hub_has_its_commit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
    repository, commit = tmp_path / "models--me--x", "0123456789" * 4
    (repository / "snapshots" / commit).mkdir(parents=True)
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text(commit)
    (repository / "snapshots" / commit / "model.safetensors").write_bytes(b"weights")
    config = act_config()
    config.pretrained_path = Path("me/x")
    who = _of_checkpoint(config)
    assert (who.path, who.revision) == ("me/x", commit)
    assert who.weights_sha256 == hashlib.sha256(b"weights").hexdigest()
