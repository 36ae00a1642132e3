"""Loading a checkpoint that is not whole or not what it is taken for: one line says what is wrong."""

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import transformers.dynamic_module_utils
from lerobot.policies import get_policy_class, make_pre_post_processors
from lerobot.scripts import lerobot_eval
from policy_cases import CASES, save_checkpoint

from hub.damage import (
    POSTPROCESSOR,
    PREPROCESSOR,
    TOKENIZER,
    WEIGHTS,
    Damage,
    change_config,
    change_step,
    insert_code,
    remove,
    take_other_shape,
    take_other_weights,
    truncate,
    write,
)
from hub.server import LoopbackHub, Repository
from lerobot_bomb import __version__

Run = Callable[..., None]
REPO_ID = "me/x"


class LoadedError(Exception):
    """Policy and processors are there; no episode is run."""


@pytest.fixture
def evaluate(stock_cli: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """`lerobot-eval --policy.path=...` up to its first episode."""

    def stop(*_: object, **__: object) -> None:
        raise LoadedError

    monkeypatch.setattr(lerobot_eval, "eval_policy_all", stop)
    own = "--policy.device=cpu --env.type=bomb --env.task=place --env.image_size=64"
    own += " --eval.n_episodes=1 --eval.batch_size=1 --eval.use_async_envs=false"
    output = f"--output_dir={tmp_path / 'eval'}"
    return lambda path: stock_cli("lerobot-eval", f"--policy.path={path}", output, *own.split())


def told(load: Callable[[], object], capsys: pytest.CaptureFixture[str]) -> str:
    """Return what the user reads last."""
    capsys.readouterr()
    try:
        load()
    except SystemExit as end:  # of LeRobot's parser, which has printed it
        assert end.code == 1
        return capsys.readouterr().err.strip().splitlines()[-1]
    except Exception as error:
        return str(error)
    raise AssertionError("it was loaded")


def put(hub: LoopbackHub, folder: Path) -> None:
    repository = Repository()
    repository.commit({path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}, "push")
    hub.repositories[f"models/{REPO_ID}"] = repository


# wherever a checkpoint is
CONFIGS: dict[str, Damage] = {
    "config.json is not a JSON object": write("config.json", '"vla0_smol"'),
    "its config.json cannot be read: ": write("config.json", "[]"),
    "config.json is nested more than 100 levels deep": write(
        "config.json", f'{{"type": "vla0_smol", "vlm_config": {1000 * '{"a":'} 0 {1001 * "}"}'
    ),
    "its type is ['vla0_smol'], not the name of a policy type": change_config(type=["vla0_smol"]),
    "its type is {'vla0_smol': 1}, not the name of a policy type": change_config(type={"vla0_smol": 1}),
}
NEWER = change_config(package_version="99.0", new_flag=1)
# of the policy: evaluation and Python alike
POLICY: dict[str, Damage] = {
    "config.json not found in": remove("config.json"),
    "config.json is not JSON, or truncated: Unterminated string": write("config.json", '{"type": "vla0'),
    "its config.json cannot be read: Policy type 'vla9' (from config.json of": change_config(type="vla9"),
    **CONFIGS,
    "written by lerobot_bomb 99.0, newer than the installed 0.1.0: update lerobot_bomb": NEWER,
    "holds no model.safetensors, so it is no whole checkpoint": remove(WEIGHTS),
    "model.safetensors is truncated or no safetensors file": truncate(WEIGHTS),
    "model.safetensors is not of the vla0_smol that config.json describes: it lacks": take_other_weights,
    "has shape (1,), not (": take_other_shape,
    "policy_preprocessor.json is not JSON, or truncated": truncate(PREPROCESSOR),
    f"holds no {TOKENIZER}, which its policy_preprocessor.json needs": remove(TOKENIZER),
    f"{TOKENIZER} is truncated or no safetensors file": truncate(TOKENIZER),
    "policy_preprocessor.json: its step 'os.mkdir' is named by the path of a class": insert_code(
        PREPROCESSOR
    ),
    "state_file='../../x.safetensors' is no name": change_step(
        PREPROCESSOR, "bomb_task_tokenizer", state_file="../../x.safetensors"
    ),
}
# a policy can be loaded alone, so only what loads the processors can miss them; LeRobot's own words
PROCESSORS: dict[str, Damage] = {
    "Config file 'policy_preprocessor.json' not found": remove(PREPROCESSOR),
    "Config file 'policy_postprocessor.json' not found": remove(POSTPROCESSOR),
    "Original error: Config file 'policy_preprocessor.json' not found": remove(PREPROCESSOR, POSTPROCESSOR),
}


@pytest.mark.parametrize("message", POLICY)
def test_a_broken_folder_is_told_in_a_line(
    message: str, checkpoint: Path, evaluate: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    POLICY[message](checkpoint)
    for load in (evaluate, get_policy_class("vla0_smol").from_pretrained):
        text = told(lambda load=load: load(str(checkpoint)), capsys)
        assert message in text
        assert len(text.splitlines()) == 1
    assert not (checkpoint.parent / "ran").exists()


@pytest.mark.parametrize("message", PROCESSORS)
def test_missing_processors_are_named(
    message: str, checkpoint: Path, evaluate: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    PROCESSORS[message](checkpoint)
    assert message in told(lambda: evaluate(checkpoint), capsys).splitlines()[-1]


ON_THE_HUB: dict[str, Damage] = {
    f"config.json not found on the HuggingFace Hub in {REPO_ID}": remove("config.json"),
    f"model.safetensors not found on the HuggingFace Hub in {REPO_ID}": remove(WEIGHTS),
    "newer than the installed 0.1.0: update lerobot_bomb": NEWER,
    "model.safetensors is truncated or no safetensors file": truncate(WEIGHTS),
    "it lacks backbone.": take_other_weights,
    "Config file 'policy_preprocessor.json' not found on the Hugging Face Hub": remove(PREPROCESSOR),
    f"{TOKENIZER}.": remove(TOKENIZER),
    "its step 'os.mkdir' is named by the path of a class": insert_code(PREPROCESSOR),
    **CONFIGS,
}


@pytest.mark.parametrize("message", ON_THE_HUB)
def test_a_broken_repository_is_told(
    message: str, online: LoopbackHub, checkpoint: Path, evaluate: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    ON_THE_HUB[message](checkpoint)
    put(online, checkpoint)
    assert message in told(lambda: evaluate(REPO_ID), capsys).splitlines()[-1]
    assert not (checkpoint.parent / "ran").exists()


def test_a_whole_checkpoint_loads_from_both(online: LoopbackHub, checkpoint: Path, evaluate: Run) -> None:
    put(online, checkpoint)
    for path in (checkpoint, REPO_ID):
        with pytest.raises(LoadedError):
            evaluate(path)


def test_no_hub_and_no_such_folder(
    online: LoopbackHub, evaluate: Run, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from huggingface_hub import constants

    misspelt = "outputs/misspelt/pretrained_model"
    text = told(lambda: evaluate(misspelt), capsys)
    assert f"there is no folder {misspelt} here, and it is no name on the Hub" in text
    files = "http://127.0.0.1:9/{repo_id}/resolve/{revision}/{filename}"
    monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", files)
    text = told(lambda: evaluate(REPO_ID), capsys)
    assert f"there is no folder {REPO_ID} here. " in text
    assert "Please check your connection" in text
    assert len(text.splitlines()) == 1


def test_the_other_class_and_a_newer_version_of_each_type(
    policy_type: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    CASES[policy_type].make_policy().save_pretrained(tmp_path)
    other = "fdvla" if policy_type == "vla0_smol" else "vla0_smol"
    text = told(lambda: get_policy_class(other).from_pretrained(tmp_path), capsys)
    assert f"this is a {policy_type}, not a {other}: load it with get_policy_class('{policy_type}')" in text
    NEWER(tmp_path)
    text = told(lambda: get_policy_class(policy_type).from_pretrained(tmp_path), capsys)
    assert "written by lerobot_bomb 99.0" in text


@pytest.mark.parametrize("version", ["0.0.9", "0.1.9"])
def test_an_older_version_and_a_later_one_of_the_same_release_are_read(version: str, tmp_path: Path) -> None:
    CASES["vla0_smol"].make_policy().save_pretrained(tmp_path)
    change_config(package_version=version)(tmp_path)
    config: Any = get_policy_class("vla0_smol").from_pretrained(tmp_path).config
    assert config.package_version == __version__


def test_nothing_is_unpickled_and_no_code_of_a_checkpoint_runs(
    policy_type: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = save_checkpoint(policy_type, tmp_path)
    for name in ("pytorch_model.bin", "model.bin", "optimizer.pkl"):
        (tmp_path / name).write_bytes(pickle.dumps("read"))
    (tmp_path / "modeling_remote.py").write_text("raise SystemExit('remote code runs')")

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a pickle is read, or remote code is run")

    for module, name in (
        (pickle, "load"),
        (pickle, "loads"),
        (pickle, "Unpickler"),
        (torch, "load"),
        (transformers.dynamic_module_utils, "get_class_from_dynamic_module"),
    ):
        monkeypatch.setattr(module, name, refuse)
    loaded = get_policy_class(policy_type).from_pretrained(tmp_path)
    assert all(torch.equal(tensor, loaded.state_dict()[name]) for name, tensor in policy.state_dict().items())
    make_pre_post_processors(loaded.config, str(tmp_path))
    (tmp_path / "model.safetensors").unlink()  # the pickle does not take its place
    with pytest.raises(FileNotFoundError, match=r"holds no model\.safetensors"):
        get_policy_class(policy_type).from_pretrained(tmp_path)
