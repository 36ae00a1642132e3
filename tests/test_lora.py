"""LoRA adapters on our policies: through `lerobot-train` and `lerobot-eval`, and in the fast decoders."""

import copy
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.envs import make_env_config
from lerobot.policies import get_policy_class, make_policy
from pointing_cases import POINTING, with_labels
from policy_cases import CASES
from safetensors.torch import load_file
from variants import TWO_LAYERS, as_flags

from lerobot_bomb.bomb.pointing import PLACES_XY_M
from lerobot_bomb.checkpoints.folder import parse_config, read_config
from lerobot_bomb.commands.main import main
from lerobot_bomb.data.facts import DatasetFacts
from lerobot_bomb.data.record import record
from lerobot_bomb.data.recording import Recording

peft = pytest.importorskip("peft")

Run = Callable[..., None]
REPO_ID = "test/lora"
NEW_PARTS = {
    "fdvla": {"segment", "state_embedding", "flow_head", "denoise_head"},
    "spatialvla_grid": {"cell_embedding", "cell_head"},
    "vla0_smol": set(),
}
# what those that point have, too; the pointer of `spatialvla_grid` is rows of its tables
POINTERS = {
    "fdvla": {"pointer", "board_reader"},
    "spatialvla_grid": {"board_reader"},
    "vla0_smol": {"pointer", "board_reader"},
}
LORA = {"method_type": "LORA", "r": 4}
# with adapters beside the text model's
OTHER_PARTS = {
    "fdvla": (),
    "spatialvla_grid": ("vision_tower", "multi_modal_projector"),
    "vla0_smol": (),
}
SMALL = {
    "fdvla": "--policy.image_size=56 --policy.head_dim=32 --policy.dualmod_dim=16 --policy.dtype=float32",
    "spatialvla_grid": "--policy.depth_source=none --policy.dtype=float32",
    "vla0_smol": "--policy.dtype=float32",
}
LAYERS = 7  # projections of a layer


def adapted(policy_type: str, **options: Any) -> tuple[Any, Any]:
    """A policy and a copy of it that has learned, with adapters that are not 0."""
    policy = CASES[policy_type].make_policy(dtype="float32", **options)
    policy.config.pretrained_path = Path("base")
    wrapped = copy.deepcopy(policy).wrap_with_peft(peft_cli_overrides=LORA)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for name, parameter in wrapped.named_parameters():
            if parameter.requires_grad:
                size = 0.2 if "lora_B" in name else 0.02
                parameter.add_(size * torch.randn(parameter.shape, generator=generator))
    return policy, wrapped.eval()


@pytest.mark.parametrize("points", [False, True])
def test_text_layers_get_adapters_and_new_parts_are_trained_whole(policy_type: str, points: bool) -> None:
    policy, wrapped = adapted(policy_type, **(POINTING[policy_type] if points else {}))
    trained = [name for name, parameter in wrapped.named_parameters() if parameter.requires_grad]
    num_layers = policy.backbone.text_config.num_hidden_layers
    adapters = [name for name in trained if "lora_A" in name]
    others = {part: [name for name in adapters if f".{part}." in name] for part in OTHER_PARTS[policy_type]}
    assert all(others.values())
    of_text = [name for name in adapters if not any(name in names for names in others.values())]
    assert len(of_text) == LAYERS * num_layers and all(".layers." in name for name in of_text)
    assert not any("visi" in name or "visual" in name for name in of_text)
    whole = {name.split(".modules_to_save")[0].split(".")[-1] for name in trained if "lora_" not in name}
    new_parts = NEW_PARTS[policy_type] | (POINTERS[policy_type] if points else set())
    without_parameters = {"pointer"} if policy_type == "vla0_smol" else set()
    assert whole == new_parts - without_parameters
    assert {*(wrapped.active_peft_config.modules_to_save or ())} == new_parts


def test_decoders_see_adapters_as_merged_weights(policy_type: str) -> None:
    policy, wrapped = adapted(policy_type)
    batch = CASES[policy_type].make_batch(policy, 3)
    plain, actions = (each.predict_action_chunk(batch) for each in (policy, wrapped))
    assert not torch.allclose(actions, plain, atol=1e-3)
    wrapped.reset()
    with wrapped.disable_adapter():
        # not to the bit: layers that may have adapters are not joined, and CPUs differ in how they add up
        torch.testing.assert_close(wrapped.predict_action_chunk(batch), plain, atol=1e-6, rtol=0)
    wrapped.reset()
    merged = wrapped.merge_and_unload()
    assert not any("lora" in name for name, _ in merged.named_modules())
    merged.reset()
    torch.testing.assert_close(merged.predict_action_chunk(batch), actions, atol=1e-4, rtol=0)


def test_adapters_name_a_folder_that_stays_whatever_the_working_directory(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "base").mkdir()
    monkeypatch.chdir(tmp_path)
    policy = CASES["vla0_smol"].make_policy()
    policy.config.pretrained_path = Path("base")
    wrapped = policy.wrap_with_peft(peft_cli_overrides=LORA)
    assert wrapped.active_peft_config.base_model_name_or_path == str(tmp_path / "base")


def test_adapters_hold_what_points(policy_type: str, tmp_path: Path) -> None:
    """Trained, saved and loaded on their base, they point and act as they did, and not as the base does."""
    cases = CASES[policy_type]
    policy = cases.make_policy(dtype="float32", **POINTING[policy_type])
    policy.save_pretrained(tmp_path / "base")
    base = type(policy).from_pretrained(tmp_path / "base").eval()
    policy.config.pretrained_path = tmp_path / "base"
    wrapped = policy.wrap_with_peft(peft_cli_overrides=LORA)
    batch = with_labels(cases.make_batch(base, 4))
    trained = {name: each for name, each in wrapped.named_parameters() if each.requires_grad}
    before = {name: each.detach().clone() for name, each in trained.items()}
    optimizer = torch.optim.AdamW(trained.values(), lr=2e-3, weight_decay=0.0)
    losses = []
    for _ in range(10):
        optimizer.zero_grad()
        loss, _ = wrapped.train()(batch)
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < losses[0]
    still = {name for name, each in trained.items() if torch.equal(each, before[name])}
    assert not still
    wrapped.save_pretrained(tmp_path / "adapters")
    again = peft.PeftModel.from_pretrained(base, tmp_path / "adapters").eval()
    row = cases.make_batch(policy, 1)
    found, expected = (each.scored().pointed(row) for each in (again, wrapped.eval()))
    with again.disable_adapter():
        of_base = again.scored().pointed(row)
    for name, value in vars(expected).items():
        assert np.array_equal(getattr(found, name), value), name
    assert [*found.place_xy, *found.stone_xy] != [*of_base.place_xy, *of_base.stone_xy]
    for each in (again, wrapped):
        each.reset()
    torch.testing.assert_close(
        again.predict_action_chunk(row), wrapped.predict_action_chunk(row), atol=1e-5, rtol=0
    )


# The stock commands


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("recorded") / "dataset"
    shape: Any = {"image_size": 64, "images": True, "control_mode": "absolute", "pointing": True}
    recording = Recording(REPO_ID, episodes=1, seed=3, **shape)
    record(recording, root)
    return root


def make_base(policy_type: str, dataset: Path, folder: Path, points: bool = False) -> Path:
    own = f"--policy.type={policy_type} --policy.vlm_model_name=nano --policy.device=cpu"
    own += f" --policy.chunk_size=3 --policy.n_action_steps=3 {SMALL[policy_type]}"
    own += f" --policy.pointing={str(points).lower()}"
    data = f"--dataset.repo_id={REPO_ID} --dataset.root={dataset}"
    assert (
        main(["checkpoint", "init", *own.split(), *as_flags(TWO_LAYERS), *data.split(), f"--output={folder}"])
        == 0
    )
    return folder


def train(run: Run, flags: str, output_dir: Path) -> Path:
    """The last checkpoint."""
    run("lerobot-train", *flags.split(), f"--output_dir={output_dir}")
    return output_dir / "checkpoints" / "last" / "pretrained_model"


@pytest.mark.one_type
@pytest.mark.parametrize("points", [False, pytest.param(True, marks=pytest.mark.long)])
def test_adapters_are_trained_resumed_and_evaluated_by_stock_commands(
    policy_type: str, points: bool, dataset: Path, stock_cli: Run, tmp_path: Path
) -> None:
    base = make_base(policy_type, dataset, tmp_path / "base", points)
    flags = f"--policy.path={base} --dataset.repo_id={REPO_ID} --dataset.root={dataset} --batch_size=2"
    flags += " --num_workers=0 --steps=2 --save_freq=1 --peft.method_type=LORA --peft.r=4"
    whole = train(stock_cli, flags, tmp_path / "whole")
    assert not (whole / "model.safetensors").exists()
    first = tmp_path / "second" / "checkpoints" / "000001"
    shutil.copytree(tmp_path / "whole" / "checkpoints" / "000001", first)
    flags = f"--config_path={first}/pretrained_model/train_config.json --resume=true"
    second = train(stock_cli, flags, tmp_path / "second")
    weights = [load_file(each / "adapter_model.safetensors") for each in (whole, second)]
    assert weights[0].keys() == weights[1].keys()
    assert all(tensor.any() for name, tensor in weights[0].items() if "lora_B" in name)
    assert all(torch.equal(weights[1][name], tensor) for name, tensor in weights[0].items())
    assert json.loads((second / "config.json").read_text())["trained_batches"] == 2
    flags = f"--policy.path={second} --env.type=bomb --env.task=place --env.image_size=64 --env.fps=1"
    flags += (
        " --env.ignore_checkpoint=true --eval.n_episodes=1 --eval.batch_size=1 --eval.use_async_envs=false"
    )
    stock_cli("lerobot-eval", *flags.split(), f"--output_dir={tmp_path / 'eval'}")
    assert json.loads((tmp_path / "eval" / "eval_info.json").read_text())["overall"]["n_episodes"] == 1
    check_merged(second, tmp_path / "merged")
    of_recording = DatasetFacts.read(dataset).environment
    for folder in (tmp_path / "moved", second, tmp_path / "merged"):
        assert getattr(parse_config(folder, "cpu"), "environment") == of_recording is not None  # noqa: B009


def check_merged(adapters: Path, output: Path) -> None:
    """Check that the merged policy acts as base and adapters do, and needs no base."""
    config = read_config(adapters, "cpu")
    wrapped = make_policy(config, env_cfg=make_env_config("bomb", image_size=64)).eval()
    assert main(["checkpoint", "merge", f"--policy.path={adapters}", f"--output={output}"]) == 0
    base = Path(peft.PeftConfig.from_pretrained(str(adapters)).base_model_name_or_path)
    base.rename(base.with_name("moved"))
    policy = get_policy_class(config.type).from_pretrained(str(output))
    assert not policy.config.use_peft and {"README.md"} >= {
        path.name for path in output.iterdir() if path.suffix not in (".json", ".safetensors")
    }
    batch = CASES[config.type].make_batch(policy, 2)
    actions = wrapped.predict_action_chunk(batch)
    torch.testing.assert_close(policy.predict_action_chunk(batch), actions, atol=1e-4, rtol=0)


def test_what_cannot_be_merged_is_told(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    base = make_base("vla0_smol", dataset, tmp_path / "base")
    assert main(["checkpoint", "merge", f"--policy.path={base}", f"--output={tmp_path / 'merged'}"]) == 1
    assert "is a whole checkpoint: there is nothing to merge" in capsys.readouterr().err
    policy = get_policy_class("vla0_smol").from_pretrained(str(base))
    policy.config.pretrained_path = tmp_path / "elsewhere"
    wrapped = policy.wrap_with_peft(peft_cli_overrides=LORA)
    wrapped.save_pretrained(tmp_path / "adapters")
    policy.config.save_pretrained(tmp_path / "adapters")
    for state in base.glob("policy_p*"):
        shutil.copy(state, tmp_path / "adapters")
    assert (
        main(
            [
                "checkpoint",
                "merge",
                f"--policy.path={tmp_path / 'adapters'}",
                f"--output={tmp_path / 'merged'}",
            ]
        )
        == 1
    )
    error = capsys.readouterr().err
    assert "elsewhere, as adapter_config.json says, which cannot be loaded: there is no folder" in error
    assert error.count("\n") == 1
    assert not (tmp_path / "merged").exists()


# Other data


def test_adapters_on_a_checkpoint_with_relative_actions_of_other_data_are_refused(
    dataset: Path, tmp_path: Path
) -> None:
    policy = CASES["vla0_smol"].make_policy(relative_actions=True)
    policy.save_pretrained(tmp_path)
    meta = LeRobotDatasetMetadata(REPO_ID, root=dataset)
    loaded = type(policy).from_pretrained(tmp_path, config=policy.config, dataset_meta=meta)
    loaded.config.pretrained_path = tmp_path
    with pytest.raises(ValueError, match=r"relative\.scale.* lerobot-bomb checkpoint init writes"):
        loaded.wrap_with_peft(peft_cli_overrides=LORA)
    loaded.save_pretrained(tmp_path / "fitted")
    fitted = type(policy).from_pretrained(tmp_path / "fitted", config=loaded.config, dataset_meta=meta)
    assert fitted.wrap_with_peft(peft_cli_overrides=LORA).config.use_peft


def test_adapters_hold_the_units_of_what_points(policy_type: str, dataset: Path, tmp_path: Path) -> None:
    """Check that they are of their own data, whatever the base was trained on."""
    places = {} if policy_type == "vla0_smol" else {"pointing_places": [*map(list, PLACES_XY_M)]}
    policy = CASES[policy_type].make_policy(**POINTING[policy_type] | places)
    policy.save_pretrained(tmp_path / "base")
    meta = LeRobotDatasetMetadata(REPO_ID, root=dataset)
    load = type(policy).from_pretrained
    fitted = load(tmp_path / "base", config=policy.config, dataset_meta=meta)
    fitted.config.pretrained_path = tmp_path / "base"
    expected = fitted.pointer
    wrapped = fitted.wrap_with_peft(peft_cli_overrides=LORA)
    wrapped.save_pretrained(tmp_path / "adapters")
    again = peft.PeftModel.from_pretrained(load(tmp_path / "base"), tmp_path / "adapters")
    if policy_type == "spatialvla_grid":  # whose labels need the dataset alone
        return
    for name in ("state_bounds", "action_bounds"):
        held, of_base = (getattr(each, name) for each in (expected, policy.pointer))
        assert torch.equal(getattr(again.pointer, name), held) and not torch.equal(held, of_base), name
