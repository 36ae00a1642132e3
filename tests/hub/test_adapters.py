"""Adapters on the Hub: they name a base there, or they are not published."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from lerobot.configs.default import DatasetConfig, PeftConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.envs import make_env_config
from lerobot.policies import get_policy_class, make_policy, make_pre_post_processors
from safetensors.torch import load_file, save_file
from vla0_smol_cases import STATS
from vla0_smol_cases import make_policy as make_vla0

from hub.damage import change_tensors, every_other, one_nan, write_checkpoint
from hub.runner import FORGET, run
from hub.server import TOKEN, LoopbackHub, Repository
from hub.test_loop import DATASET, SMALL, check_no_secret, evaluate, record, train
from lerobot_bomb.checkpoints.folder import read_config
from lerobot_bomb.commands.main import main

peft = pytest.importorskip("peft")

ADAPTERS = "adapter_model.safetensors"
BASE, REPO_ID = "me/base", "me/adapters"
LORA = {"method_type": "LORA", "r": 4}


def push_base(folder: Path) -> None:
    write_checkpoint(folder)
    assert main(["push", str(folder), f"--repo_id={BASE}"]) == 0


def adapters(base: str, **flags: Any) -> Any:
    """Add adapters to a base as `lerobot-train --policy.path=BASE --peft.method_type=LORA` does."""
    policy = get_policy_class("vla0_smol").from_pretrained(base)
    policy.config.pretrained_path = Path(base)
    for name, value in flags.items():
        setattr(policy.config, name, value)
    return policy.wrap_with_peft(peft_cli_overrides=LORA)


def save(wrapped: Any, folder: Path) -> Path:
    """Save adapters as `lerobot-train` does."""
    wrapped.save_pretrained(folder)
    wrapped.config.save_pretrained(folder)
    for processor in make_pre_post_processors(make_vla0().config, dataset_stats=STATS):
        processor.save_pretrained(folder)
    return folder


def push(folder: Path) -> int:
    return main(["push", str(folder), f"--repo_id={REPO_ID}"])


def test_adapters_of_which_a_part_is_missing_are_refused(
    online: LoopbackHub, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`peft` loads what there is, with a warning."""
    push_base(tmp_path / "base")
    folder = save(adapters(BASE), tmp_path / "adapters")
    whole = load_file(folder / ADAPTERS)
    for change in (every_other, one_nan):
        save_file(whole, folder / ADAPTERS)
        change_tensors(ADAPTERS, change)(folder)
        online.requests.clear()
        capsys.readouterr()
        assert push(folder) == 1
        pushed = capsys.readouterr().err
        assert online.requests == []
        assert (
            main(["checkpoint", "merge", f"--policy.path={folder}", f"--output={tmp_path / 'merged'}"]) == 1
        )
        merged = capsys.readouterr().err
        config = read_config(folder, "cpu")
        with pytest.raises(ValueError, match=ADAPTERS) as raised:
            make_policy(config, env_cfg=make_env_config("bomb", image_size=64))
        for text in (pushed.strip(), merged.strip(), str(raised.value)):
            assert (
                f"{folder / ADAPTERS} is not whole: it lacks base_model." in text or "is not finite" in text
            )
            assert len(text.splitlines()) == 1


def check_published(hub: LoopbackHub) -> None:
    repository = hub.model(REPO_ID)
    assert len(repository.messages) == 1
    files = repository.files()
    assert "model.safetensors" not in files
    adapter_config = json.loads(files["adapter_config.json"])
    assert adapter_config["base_model_name_or_path"] == BASE
    assert adapter_config["revision"] == hub.model(BASE).refs["main"]
    metadata = yaml.safe_load(files["README.md"].decode().split("---\n")[1])
    assert (metadata["base_model"], metadata["base_model_relation"]) == (BASE, "adapter")


def test_adapters_of_a_base_on_the_hub_load_by_name(
    online: LoopbackHub, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    push_base(tmp_path / "base")
    assert push(save(adapters(BASE), tmp_path / "adapters")) == 0
    check_published(online)
    card = online.model(REPO_ID).files()["README.md"].decode()
    assert "pip install '.[lora]'" in card
    config = read_config(tmp_path / "adapters", "cpu")
    config.pretrained_path = Path(REPO_ID)
    loaded = make_policy(config, env_cfg=make_env_config("bomb", image_size=64))
    assert isinstance(loaded, peft.PeftModel)
    code: dict[str, Any] = {}
    exec(card.split("```python\n")[1].split("action = ")[0], code)
    assert isinstance(code["policy"], peft.PeftModel)
    del online.repositories[f"models/{BASE}"]
    capsys.readouterr()
    assert push(tmp_path / "adapters") == 1
    error = capsys.readouterr().err
    assert f"the base of these adapters, {BASE}, is not on the Hub; publish that first" in error


def test_the_stock_push_of_adapters(online: LoopbackHub, tmp_path: Path) -> None:
    push_base(tmp_path / "base")
    wrapped = adapters(BASE, repo_id=REPO_ID, push_to_hub=True)
    cfg = TrainPipelineConfig(
        DatasetConfig("me/d"), policy=wrapped.config, output_dir=tmp_path / "out", peft=PeftConfig(r=4)
    )
    save(wrapped, tmp_path / "out" / "checkpoints" / "last" / "pretrained_model")
    wrapped.push_model_to_hub(cfg, peft_model=wrapped)
    check_published(online)
    text = online.model(REPO_ID).files()["README.md"].decode().replace(" \\\n    ", " ")
    assert f"lerobot-train --policy.path={BASE}" in text
    assert text.count("--peft.method_type=LORA --peft.r=4") == 2


def test_adapters_of_a_folder_are_refused_before_training_and_before_any_request(
    online: LoopbackHub, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_checkpoint(tmp_path / "base")
    with pytest.raises(ValueError, match=r"base, is on this machine only; .*lerobot-bomb checkpoint merge"):
        adapters(str(tmp_path / "base"), repo_id=REPO_ID, push_to_hub=True)
    wrapped = adapters(str(tmp_path / "base"), repo_id=REPO_ID)
    folder = save(wrapped, tmp_path / "adapters")
    assert push(folder) == 1
    error = capsys.readouterr().err
    assert "is on this machine only; publish that first" in error
    assert "lerobot-bomb checkpoint merge" in error
    assert error.count("\n") == 1
    cfg = TrainPipelineConfig(DatasetConfig("me/d"), policy=wrapped.config, output_dir=tmp_path / "out")
    with pytest.raises(ValueError, match=r"lerobot-bomb checkpoint merge"):
        wrapped.push_model_to_hub(cfg, peft_model=wrapped)
    assert online.requests == []


def test_a_pickle_does_not_take_the_place_of_adapters(online: LoopbackHub, tmp_path: Path) -> None:
    push_base(tmp_path / "base")
    folder = save(adapters(BASE), tmp_path / "adapters")
    weights = load_file(folder / "adapter_model.safetensors")
    (folder / "adapter_model.safetensors").unlink()
    torch.save(weights, folder / "adapter_model.bin")
    repository = online.repositories.setdefault(f"models/{REPO_ID}", Repository())
    repository.commit({path.name: path.read_bytes() for path in folder.iterdir()}, "with a pickle")
    config = read_config(folder, "cpu")
    for path, message in (
        (folder, "holds no adapter_model"),
        (REPO_ID, "safetensors not found"),
    ):
        config.pretrained_path = Path(path)
        with pytest.raises(FileNotFoundError, match=message):
            make_policy(config, env_cfg=make_env_config("bomb", image_size=64))
    assert main(["checkpoint", "merge", f"--policy.path={folder}", f"--output={tmp_path / 'merged'}"]) == 1


@pytest.mark.long
def test_train_push_forget_and_evaluate_adapters(policy_type: str, hub: LoopbackHub, tmp_path: Path) -> None:
    """Check all of it by commands alone, on a base that `lerobot-bomb checkpoint init` wrote."""
    data = [f"--dataset.repo_id={DATASET}", f"--dataset.root={tmp_path / 'dataset'}"]
    own = [f"--policy.type={policy_type}", "--policy.vlm_model_name=nano", "--policy.device=cpu"]
    output = f"--output={tmp_path / 'base'}"
    ended = run(
        [
            record(tmp_path / "dataset"),
            ["lerobot-bomb", "checkpoint", "init", *own, *SMALL[policy_type].split(), *data, output],
            ["lerobot-bomb", "push", str(tmp_path / "base"), f"--repo_id={BASE}"],
            train(
                *(tmp_path, "lora", f"--policy.path={BASE}", f"--policy.repo_id={REPO_ID}", data[1]),
                *("--peft.method_type=LORA", "--peft.r=4"),
            ),
            FORGET,
            evaluate(REPO_ID, tmp_path / "eval"),
        ],
        hub.endpoint,
        tmp_path / "home",
        TOKEN,
    )
    assert ended.code == 0, ended.text
    check_published(hub)
    assert (tmp_path / "eval" / "eval_info.json").is_file()
    check_no_secret(hub, ended, tmp_path)
