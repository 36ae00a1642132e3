"""A checkpoint is data: what its JSON files could run, read or leave out is refused before it is used."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import get_policy_class, make_pre_post_processors
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.processor import (
    ActionTokenizerProcessorStep,
    DataProcessorPipeline,
    IdentityProcessorStep,
    ProcessorStep,
)
from lerobot.utils.import_utils import register_third_party_plugins
from policy_cases import save_checkpoint

from hub.damage import (
    POSTPROCESSOR,
    PREPROCESSOR,
    TOKENIZER,
    Damage,
    change_config,
    change_state,
    change_step,
    insert_code,
    insert_step,
    write,
    write_checkpoint,
)
from hub.server import LoopbackHub, Repository
from lerobot_bomb.checkpoints import processor_files
from lerobot_bomb.checkpoints.adapters import check_adapters
from lerobot_bomb.checkpoints.folder import load_processors, read_config
from lerobot_bomb.compat.use import use
from lerobot_bomb.explain.interventions import intervene
from lerobot_policy_bomb.vla0_smol import Vla0SmolConfig

UNNORMALIZER = "policy_postprocessor_step_0_unnormalizer_processor.safetensors"
NAN = torch.tensor([float("nan"), 1.0, 1.0, 1.0])
TASK, FAST = "bomb_task_tokenizer", "action_tokenizer_processor"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    register_third_party_plugins()
    folder = tmp_path_factory.mktemp("whole") / "pretrained_model"
    write_checkpoint(folder)
    return folder


@pytest.fixture
def folder(whole: Path, tmp_path: Path) -> Path:
    return shutil.copytree(whole, tmp_path / "pretrained_model")


def stock_load(folder: Path | str) -> Any:
    """Load processors as LeRobot's commands do."""
    return make_pre_post_processors(Vla0SmolConfig(device="cpu"), str(folder))


def act_checkpoint(folder: Path) -> ACTConfig:
    features = {"observation.state": PolicyFeature(FeatureType.STATE, (2,))}
    features["observation.images.front"] = PolicyFeature(FeatureType.VISUAL, (3, 8, 8))
    action = {"action": PolicyFeature(FeatureType.ACTION, (2,))}
    config = ACTConfig(device="cpu", input_features=features, output_features=action)
    numbers = {"mean": torch.zeros(2), "std": torch.ones(2)}
    images = {"mean": torch.zeros(3, 1, 1), "std": torch.ones(3, 1, 1)}
    stats = {"observation.state": numbers, "action": numbers, "observation.images.front": images}
    for processor in make_pre_post_processors(config, dataset_stats=stats):  # pyright: ignore[reportArgumentType]
        processor.save_pretrained(folder)
    config.save_pretrained(folder)
    return config


# what LeRobot's loader is kept from, and every command of ours
REFUSED: dict[str, Damage] = {
    "its step 'os.mkdir' is named by the path of a class": insert_code(PREPROCESSOR),
    "policy_postprocessor: its step 'os.mkdir' is": insert_code(POSTPROCESSOR),
    "its step None is named by the path of a class": insert_step(PREPROCESSOR, {"class": None}),
    "its step 'json.JSONDecoder' is named": insert_step(PREPROCESSOR, {"class": "json.JSONDecoder"}),
    "no step 'vla9' is registered": insert_step(PREPROCESSOR, {"registry_name": "vla9"}),
    "no step ['vla9'] is registered": insert_step(PREPROCESSOR, {"registry_name": ["vla9"]}),
    "'action_tokenizer_processor' runs code of what its config names ({'action_tokenizer_name': 'evil/x'})": (
        insert_step(PREPROCESSOR, {"registry_name": FAST, "config": {"action_tokenizer_name": "evil/x"}})
    ),
    "'reward_classifier_processor' runs code of what": insert_step(
        POSTPROCESSOR, {"registry_name": "reward_classifier_processor", "config": {"pretrained_path": "x"}}
    ),
    "'tokenizer_processor' reads other files": insert_step(
        PREPROCESSOR, {"registry_name": "tokenizer_processor", "config": {"tokenizer_name": "/home"}}
    ),
    "state_file='../x.safetensors' is no name": change_step(
        PREPROCESSOR, TASK, state_file="../x.safetensors"
    ),
    "state_file='/x.safetensors' is no name": change_step(PREPROCESSOR, TASK, state_file="/x.safetensors"),
    "state_file='config.json' is no name": change_step(PREPROCESSOR, TASK, state_file="config.json"),
    "artifacts of its step 'bomb_task_tokenizer' are other files": change_step(
        PREPROCESSOR, TASK, artifacts={"tokenizer": "tokenizer"}
    ),
    "names no state_file, so it has no tokenizer": change_step(PREPROCESSOR, TASK, state_file=None),
    "the config of its step 'bomb_task_tokenizer' is no JSON": change_step(PREPROCESSOR, TASK, config=[]),
    "template='Task: {0.__class__}' must hold {} once": change_step(
        PREPROCESSOR, TASK, config={"template": "Task: {0.__class__}"}
    ),
    "template='Task:' must hold {} once": change_step(PREPROCESSOR, TASK, config={"template": "Task:"}),
    "tokenizer='x' must be a Tokenizer": change_step(PREPROCESSOR, TASK, config={"tokenizer": "x"}),
    "must be 'tokenizer_json' alone; it is ['other']": change_state(
        TOKENIZER, tokenizer_json=None, other=torch.zeros(1)
    ),
    "the saved tokenizer cannot be read": change_state(
        TOKENIZER, tokenizer_json=torch.zeros(9, dtype=torch.uint8)
    ),
    "policy_postprocessor lacks the step 'unnormalizer_processor' of a vla0_smol": write(
        POSTPROCESSOR, '{"name": "policy_postprocessor", "steps": []}'
    ),
    "its statistics lack action.min, which MIN_MAX needs": change_state(UNNORMALIZER, action__min=None),
    "action.min has shape (1,), not (4,)": change_state(UNNORMALIZER, action__min=torch.zeros(1)),
    "action.max is not finite: 1 of 4 values": change_state(UNNORMALIZER, action__max=NAN),
}


@pytest.mark.parametrize("message", REFUSED)
def test_processors_that_are_no_data_or_not_whole_are_refused(message: str, folder: Path) -> None:
    REFUSED[message](folder)
    with pytest.raises(ValueError) as told:
        stock_load(folder)
    assert message in str(told.value)
    with pytest.raises(ValueError):
        load_processors(read_config(folder, "cpu"))
    assert not (folder.parent / "ran").exists()


def test_the_hub_s_processors_are_checked_and_of_one_commit(
    online: LoopbackHub, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def commit() -> None:
        files = {path.name: path.read_bytes() for path in folder.iterdir()}
        online.repositories.setdefault("models/me/x", Repository()).commit(files, "push")

    commit()
    usual = processor_files.state_files

    def commit_meanwhile(*args: Any) -> list[str]:
        if args[0]["name"] == "policy_postprocessor":
            change_state(UNNORMALIZER, action__max=torch.full((4,), 7.0))(folder)
            commit()
        return usual(*args)

    with monkeypatch.context() as patch:
        patch.setattr(processor_files, "state_files", commit_meanwhile)
        before = stock_load("me/x")[1].steps[0].stats["action"]["max"]
    assert (before != 7).all()
    assert (stock_load("me/x")[1].steps[0].stats["action"]["max"] == 7).all()
    insert_code(POSTPROCESSOR)(folder)
    commit()
    with pytest.raises(ValueError, match=r"its step 'os\.mkdir' is named by the path of a class"):
        stock_load("me/x")
    assert not (folder.parent / "ran").exists()


@pytest.mark.parametrize("name", [TOKENIZER, UNNORMALIZER])
def test_a_state_that_is_a_link_out_of_the_folder_is_refused(name: str, folder: Path) -> None:
    elsewhere = folder.parent / "elsewhere.safetensors"
    (folder / name).rename(elsewhere)
    (folder / name).symlink_to(elsewhere)
    told = rf"{folder / name} is a link to {elsewhere}, out of the checkpoint's folder"
    for load in (stock_load, lambda folder: load_processors(read_config(folder, "cpu"))):
        with pytest.raises(ValueError, match=told):
            load(folder)
    elsewhere.rename(folder / "kept.safetensors")
    (folder / name).unlink()
    (folder / name).symlink_to("kept.safetensors")
    linked = folder.parent / "last"
    linked.symlink_to(folder)
    stock_load(linked)


def test_stock_types_load_and_run_no_code(tmp_path: Path) -> None:
    register_third_party_plugins()
    use()
    folder = tmp_path / "act"
    config = act_checkpoint(folder)
    before, after = make_pre_post_processors(config, str(folder))
    assert len(before.steps) == 4
    insert_step(POSTPROCESSOR, {"class": f"{IdentityProcessorStep.__module__}.IdentityProcessorStep"})(folder)
    assert len(make_pre_post_processors(config, str(folder))[1].steps) == len(after.steps) + 1
    saved = (folder / PREPROCESSOR).read_text()
    path = f"{ActionTokenizerProcessorStep.__module__}.{ActionTokenizerProcessorStep.__name__}"
    insert_step(PREPROCESSOR, {"class": path, "config": {"action_tokenizer_name": "evil/x"}})(folder)
    with pytest.raises(ValueError, match=r"'action_tokenizer_processor' runs code of what its config names"):
        make_pre_post_processors(config, str(folder))
    for artifacts, told in (({"x": "../x"}, r"'\.\./x'"), ({"x": "/x"}, "'/x'"), (["x"], r"\['x'\]")):
        (folder / PREPROCESSOR).write_text(saved)
        step = {"registry_name": "smolvla_new_line_processor", "config": {}, "artifacts": artifacts}
        insert_step(PREPROCESSOR, step)(folder)
        with pytest.raises(ValueError, match=rf"artifacts of its step .*: {told} is no path in the"):
            make_pre_post_processors(config, str(folder))
    (folder / PREPROCESSOR).write_text(saved)
    insert_code(PREPROCESSOR)(folder)
    with pytest.raises(ValueError, match=r"its step 'os\.mkdir' is named"):
        make_pre_post_processors(config, str(folder))
    with pytest.raises(ValueError, match=r"its step 'os\.mkdir' is named"):
        DataProcessorPipeline.from_pretrained(folder / PREPROCESSOR, config_filename=PREPROCESSOR)
    assert not (tmp_path / "ran").exists()


def test_whole_checkpoints_of_all_types_load(policy_type: str, tmp_path: Path) -> None:
    register_third_party_plugins()
    save_checkpoint(policy_type, tmp_path)
    before, after = load_processors(read_config(tmp_path, "cpu"))
    assert (len(before.steps), len(after.steps)) == (5, 2)


UNSAFE: dict[str, dict[str, Any]] = {
    "does not hold the architecture": {"vlm_config": None},
    "its vlm_config names code": {"vlm_config": {"text_config": {"attn_implementation": "evil/kernel"}}},
    "its vlm_config names code to run": {"vlm_config": {"trust_remote_code": True}},
}


@pytest.mark.parametrize("message", UNSAFE)
def test_a_config_that_reads_other_models_or_code_is_refused(message: str, folder: Path) -> None:
    change_config(**UNSAFE[message])(folder)
    for config in (None, read_config(folder, "cpu")):
        with pytest.raises(ValueError, match=message):
            get_policy_class("vla0_smol").from_pretrained(folder, config=config)


@pytest.mark.parametrize(
    "values",
    [
        {"megatron_config": {"x": 1}, "megatron_core": "antigravity"},
        {"tokenizer_name_or_path": "evil/x", "tokenizer_kwargs": {"trust_remote_code": True}},
        {"corda_config": {"cache_file": "/x.pt"}},
        {"peft_type": "XLORA", "adapters": {"0": "evil/x"}},
    ],
    ids=lambda values: next(iter(values)),
)
def test_adapters_that_read_other_files_or_code_are_refused(values: dict[str, Any], folder: Path) -> None:
    shutil.copy(folder / UNNORMALIZER, folder / "adapter_model.safetensors")
    content = {"peft_type": "LORA", "r": 4, "megatron_core": "megatron.core", "megatron_config": None}
    (folder / "adapter_config.json").write_text(json.dumps(content))
    check_adapters(str(folder), None)
    (folder / "adapter_config.json").write_text(json.dumps(content | values))
    with pytest.raises(ValueError, match=r"by which peft reads other files or imports code"):
        check_adapters(str(folder), None)


def test_an_intervention_that_no_command_could_load_is_refused(folder: Path, tmp_path: Path) -> None:
    class Unregistered(IdentityProcessorStep):
        pass

    step: ProcessorStep = Unregistered()
    with pytest.raises(ValueError, match="Unregistered is not registered"):
        intervene(folder, [step], tmp_path / "output")
    assert not (tmp_path / "output").exists()
