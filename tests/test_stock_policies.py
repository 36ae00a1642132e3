"""LeRobot's own policies on BOMB, through its own commands: docs/your_policy.md."""

from collections.abc import Callable
from math import ceil
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from lerobot.configs import parser
from lerobot.policies.factory import get_policy_class
from lerobot.scripts import lerobot_eval
from recipes import FOLDER
from safetensors.torch import load_file
from stock_policies import BASE, FLAGS, flags_of, shrink_gemma, write_base, write_folders

from lerobot_bomb.commands.main import main
from lerobot_bomb.results.bomb import EpisodeResult
from lerobot_bomb.results.groups import read_results

Run = Callable[..., None]
REPO_ID = "test/bomb_place"
NEEDS = {"diffusion": "diffusers", "pi0_fast": "scipy"}  # beyond what this package installs
LONG = ("diffusion", "pi0", "pi05", "pi0_fast")  # much as act and smolvla
FROM_SCRATCH = ("act", "diffusion")
# what xvla's preset says of training, said again for the evaluation
RENAMED = (
    '--rename_map={"observation.images.workspace": "observation.images.image", '
    '"observation.images.wrist": "observation.images.image2"}'
)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("recorded") / "dataset"
    flags = [f"--repo_id={REPO_ID}", f"--root={root}", "--episodes=1", "--image_size=64", "--images"]
    assert main(["record", *flags]) == 0
    return root


def train(run: Run, stock_type: str, dataset: Path, folder: Path) -> Path:
    """The checkpoint of one step by the preset, made small; what it fine-tunes has random weights."""
    preset = FOLDER / f"train_{stock_type}_bomb.yaml"
    written = yaml.safe_load(preset.read_text())["policy"]
    changed: dict[str, Any] = {name: BASE for name in ("path", "pretrained_path") if name in written}
    if "dtype" in written:
        changed["dtype"] = "float32"  # a process has one precision, and other tests share it
    data = [f"--dataset.repo_id={REPO_ID}", f"--dataset.root={dataset}", f"--output_dir={folder / 'train'}"]
    short = "--batch_size=2 --num_workers=0 --steps=1 --save_freq=1 --wandb.enable=false"
    run("lerobot-train", f"--config_path={preset}", *flags_of(stock_type, **changed), *data, *short.split())
    return folder / "train" / "checkpoints" / "last" / "pretrained_model"


def evaluate(run: Run, checkpoint: Path, folder: Path, *flags: str) -> list[EpisodeResult]:
    """Run one perturbed episode of 10 steps."""
    env = "--env.type=bomb --env.image_size=64 --env.fps=1 --env.ignore_checkpoint=true"
    batch = "--eval.n_episodes=1 --eval.batch_size=1 --eval.use_async_envs=false --policy.device=cpu"
    results = folder / "results.jsonl"
    where = [f"--env.results_path={results}", f"--output_dir={folder / 'eval'}"]
    condition = '--env.perturbations=["camera:3"]'
    parser._config_yaml_overrides.clear()  # of the training
    run(
        "lerobot-eval",
        f"--policy.path={checkpoint}",
        *env.split(),
        condition,
        *batch.split(),
        *where,
        *flags,
    )
    return read_results(results, EpisodeResult)


def check_weights(stock_type: str, checkpoint: Path, folder: Path) -> None:
    """Check weights: the base's after one small step, and loaded as saved; some types only print failures."""
    trained = load_file(checkpoint / "model.safetensors")
    if stock_type not in FROM_SCRATCH:
        for name, weights in load_file(folder / BASE / "model.safetensors").items():
            torch.testing.assert_close(trained[name], weights, rtol=0, atol=1e-3)
    loaded = get_policy_class(stock_type).from_pretrained(checkpoint).state_dict()
    for name, weights in trained.items():
        torch.testing.assert_close(loaded[name], weights, rtol=0, atol=0)


@pytest.fixture
def prepared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Path]:
    """Make a type small, and the folder with what it reads the working directory."""

    def prepare(stock_type: str) -> Path:
        if stock_type in NEEDS:
            pytest.importorskip(NEEDS[stock_type])
        monkeypatch.chdir(tmp_path)
        for read_before in (
            "_config_path_args",
            "_config_yaml_overrides",
        ):  # LeRobot keeps them in the process
            monkeypatch.setattr(parser, read_before, {})
        write_folders(tmp_path)
        if stock_type.startswith("pi"):
            shrink_gemma(monkeypatch, stock_type)
        if stock_type not in FROM_SCRATCH:
            write_base(stock_type, tmp_path / BASE)
        return tmp_path

    return prepare


@pytest.mark.parametrize(
    "stock_type",
    [pytest.param(name, marks=pytest.mark.long if name in LONG else ()) for name in FLAGS if name != "xvla"],
)
def test_a_stock_policy_is_trained_and_evaluated_by_the_stock_commands(
    stock_type: str, dataset: Path, stock_cli: Run, prepared: Callable[[str], Path]
) -> None:
    folder = prepared(stock_type)
    checkpoint = train(stock_cli, stock_type, dataset, folder)
    check_weights(stock_type, checkpoint, folder)
    (row,) = evaluate(stock_cli, checkpoint, folder)
    assert row.spec.perturbations == "camera:3"
    assert row.inference is not None
    assert row.inference.num_queries == ceil(row.steps / FLAGS[stock_type]["n_action_steps"])


def test_xvla_is_evaluated_once_the_processors_of_libero_are_left_out(
    dataset: Path, stock_cli: Run, prepared: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = prepared("xvla")
    checkpoint = train(stock_cli, "xvla", dataset, folder)
    check_weights("xvla", checkpoint, folder)
    with pytest.raises(ValueError, match=r"has values outside \[0, 255\] range"):
        evaluate(stock_cli, checkpoint, folder / "with", RENAMED)
    monkeypatch.setattr(
        lerobot_eval, "make_env_pre_post_processors", lambda env_cfg, policy_cfg: env_cfg.get_env_processors()
    )
    (row,) = evaluate(stock_cli, checkpoint, folder / "without", RENAMED)
    assert row.spec.perturbations == "camera:3"
