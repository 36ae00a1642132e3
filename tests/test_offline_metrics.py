import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets import LeRobotDatasetMetadata, dataset_metadata
from lerobot.scripts import lerobot_train

from lerobot_bomb.checkpoints.folder import load_processors, read_config
from lerobot_bomb.commands.main import main
from lerobot_bomb.data.record import record
from lerobot_bomb.data.recording import Recording
from lerobot_bomb.evaluation.offline_metrics import evenly_spaced, measure_columns
from lerobot_bomb.evaluation.predictions import load_dataset, load_network
from lerobot_bomb.evaluation.splits import Split, make_split, trained_episodes

REPO_ID = "test/offline"
NUM_BINS = 11
CHUNK = 3


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record five episodes at 2 steps a second, about ten frames each; no four share an instruction."""
    path = tmp_path_factory.mktemp("offline") / "dataset"
    record(Recording(REPO_ID, episodes=5, seed=3, image_size=32, fps=2, images=True, task_ids=(7,)), path)
    return path


@pytest.fixture(scope="module")
def train(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """train("act", "--steps=1"): folder of the checkpoint of one step of the stock lerobot-train."""

    def run(policy_type: str, *flags: str) -> Path:
        output = tmp_path_factory.mktemp("trained") / "train"
        own = f"--policy.type={policy_type} --policy.device=cpu --policy.chunk_size={CHUNK}"
        shared = f"--dataset.repo_id={REPO_ID} --dataset.root={root} --output_dir={output} --num_workers=0"
        rest = f"--policy.n_action_steps={CHUNK} --policy.push_to_hub=false --batch_size=2 --steps=1"
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", ["lerobot-train", *f"{own} {shared} {rest}".split(), *flags])
            lerobot_train.main()
        return output / "checkpoints" / "000001" / "pretrained_model"

    return run


@pytest.fixture(scope="module")
def checkpoint(train: Callable[..., Path]) -> Path:
    options = (f"n_action_bins={NUM_BINS}", "bin_mode=levels", "vlm_model_name=nano", "crop_fraction=1.0")
    return train("vla0_smol", "--dataset.episodes=[0,1]", *(f"--policy.{option}" for option in options))


@pytest.fixture(scope="module")
def by_heart(checkpoint: Path, root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The checkpoint after it learned the first and the last frame of episode 0."""
    config, meta = read_config(checkpoint, None), LeRobotDatasetMetadata(REPO_ID, root=root)
    policy, dataset = load_network(config), load_dataset(config, meta, [0])
    raw = torch.utils.data.default_collate([dataset[0], dataset[len(dataset) - 1]])
    batch = load_processors(config)[0](raw)
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=2e-3, weight_decay=0.0)
    for _ in range(400):
        loss, _ = policy.forward(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if loss < 0.01:
            break
    path = tmp_path_factory.mktemp("by_heart") / "pretrained_model"
    shutil.copytree(checkpoint, path)
    policy.save_pretrained(path)
    return path


def columns_of(checkpoint: Path, root: Path, split: Split, max_frames: int, batch_size: int) -> Any:
    meta = LeRobotDatasetMetadata(REPO_ID, root=root)
    return measure_columns(read_config(checkpoint, None), meta, split, max_frames, batch_size)


def test_frames_are_evenly_spaced() -> None:
    assert evenly_spaced(np.arange(10, 21), 3).tolist() == [10, 15, 20]
    assert evenly_spaced(np.arange(4), 9).tolist() == evenly_spaced(np.arange(4), 0).tolist() == [0, 1, 2, 3]


# Policies


def test_loss_and_l1_equal_a_plain_loop(checkpoint: Path, root: Path) -> None:
    config, meta = read_config(checkpoint, None), LeRobotDatasetMetadata(REPO_ID, root=root)
    policy, dataset = load_network(config), load_dataset(config, meta, [2, 3])
    preprocess, postprocess = load_processors(config)
    losses, accuracies, errors = [], [], []
    for index in range(len(dataset)):
        raw = torch.utils.data.default_collate([dataset[index]])
        batch = preprocess(raw)
        with torch.no_grad():
            loss, metrics = policy.forward(batch)
            actions = postprocess(policy.predict_action_chunk(batch))
        assert metrics is not None
        losses.append(loss.item())
        accuracies.append(metrics["token_accuracy"])
        errors.append((actions - raw["action"]).abs()[~raw["action_is_pad"]])
    expected = torch.cat(errors)
    column = columns_of(checkpoint, root, Split([0, 1], [2, 3], []), 0, 7)["validation"]
    assert column.num_frames == column.num_frames_measured == len(dataset)
    assert column.losses["loss"].mean == pytest.approx(np.mean(losses), rel=1e-5)
    assert column.losses["token_accuracy"].mean == pytest.approx(np.mean(accuracies), rel=1e-5)
    assert column.l1["policy"].all.mean == pytest.approx(expected.mean().item(), rel=1e-5)
    dims = [estimate.mean for estimate in column.l1["policy"].dims.values()]
    assert dims == pytest.approx(expected.mean(dim=0).tolist(), rel=1e-5)


def test_a_policy_that_knows_the_frames_by_heart(by_heart: Path, root: Path) -> None:
    column = columns_of(by_heart, root, Split([0], [3], []), 2, 2)["train"]
    assert column.losses["token_accuracy"].mean == 1.0
    # levels over [-1, 1] of the dataset's range: an action is at most half a distance of two levels off
    stats: Any = LeRobotDatasetMetadata(REPO_ID, root=root).stats
    half_bins = (stats["action"]["max"] - stats["action"]["min"]) / (NUM_BINS - 1) / 2
    for estimate, half_bin in zip(column.l1["policy"].dims.values(), half_bins, strict=True):
        assert estimate.mean <= half_bin
    assert column.l1["policy"].all.mean < 0.3 * column.l1["mean"].all.mean


def test_batches_do_not_matter_and_the_json_holds_it_all(
    checkpoint: Path, root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    figures = []
    for batch_size in (1, 5):
        path = tmp_path / f"{batch_size}.json"
        flags = [f"--policy.path={checkpoint}", f"--dataset.repo_id={REPO_ID}", f"--dataset.root={root}"]
        more = ["--max_frames=8", f"--batch_size={batch_size}", f"--json={path}"]
        assert main(["checkpoint", "offline-metrics", *flags, *more]) == 0
        figures.append(json.loads(path.read_text()))
    table = capsys.readouterr().out
    one, five = (written["columns"] for written in figures)
    assert one["validation"]["episodes"] == [2, 3, 4]
    for name in ("train", "validation"):
        assert one[name]["num_frames_measured"] == 8
        assert numbers(five[name]) == pytest.approx(numbers(one[name]), rel=1e-5)
    mean = one["validation"]["l1"]["extrapolate"]["all"]["mean"]
    labels = [line.split("  ")[0].strip() for line in table.splitlines()]
    start = labels.index("episodes")
    assert labels[start : start + 3] == ["episodes", "frames", "loss"]
    assert any(label.startswith("forward: ") for label in labels) and "forward: loss" not in labels
    assert "L1 by step of the chunk, validation" in table.splitlines()
    steps = [label for label in labels if label.isdecimal()]
    assert steps == 2 * ["1", "2", "3"]  # of two runs
    assert f"{mean:.4g}" in next(line for line in table.splitlines() if line.startswith("L1, extrapolate"))
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["1.json", "5.json"]


def numbers(value: Any) -> list[float]:
    """Return all numbers of nested dicts and lists."""
    if isinstance(value, dict | list):
        return [x for item in (value.values() if isinstance(value, dict) else value) for x in numbers(item)]
    return [] if value is None else [value]


def test_lerobots_act_has_columns_too(train: Callable[..., Path], root: Path) -> None:
    small = ("dim_model=32", "dim_feedforward=32", "n_heads=2", "pretrained_backbone_weights=null")
    path = train("act", "--dataset.eval_split=0.5", *(f"--policy.{option}" for option in small))
    meta = LeRobotDatasetMetadata(REPO_ID, root=root)
    trained = trained_episodes(json.loads((path / "train_config.json").read_text()), meta)
    columns = columns_of(path, root, make_split(5, trained, None, None), 4, 4)
    for column in columns.values():
        # in evaluation act predicts without its VAE, so the loss is its L1 in normalised units
        assert column.losses["loss"].mean == pytest.approx(column.losses["l1_loss"].mean)
        assert column.l1["policy"].all.mean > 0


def test_one_action_at_a_time_has_columns_too(train: Callable[..., Path], root: Path) -> None:
    one = ("chunk_size=1", "n_action_steps=1", "mask_max_fraction=0", "vlm_model_name=nano")
    path = train("vla0_smol", *(f"--policy.{option}" for option in one))
    columns = columns_of(path, root, Split([0, 1], [2, 3], []), 4, 4)
    assert all(column.num_frames_measured == 4 for column in columns.values())
    assert all(column.l1["policy"].all.mean > 0 for column in columns.values())


# Bad input


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--policy.path=nowhere", "--policy.path=nowhere: there is no such folder"),
        ("--dataset.root=nowhere", "--dataset.root=nowhere holds no meta/info.json"),
        ("--dataset.root=.", "--dataset.root=. holds no meta/info.json"),
        ("--val_episodes=2-9", "--val_episodes=2-9: the dataset has the episodes 0..4, not 9"),
        ("--val_episodes=two", "--val_episodes=two: give numbers and ranges"),
        ("--val_episodes=2 --train_episodes=0-2", "both name the episodes [2]"),
        ("--train_episodes=0-4", "none is held out; name some with --val_episodes"),
        ("--device=cuda", "the device cuda is not available on this machine"),
        ("--device=abacus", "Unknown device abacus"),
        ("--json=nowhere/a.json", "--json=nowhere/a.json cannot be written"),
        ("--max_frames=-1", "--max_frames=-1 must be at least 0"),
        ("--batch_size=0", "--batch_size=0 must be at least 1"),
    ],
)
def test_bad_flags_are_one_line(
    flags: str,
    message: str,
    checkpoint: Path,
    root: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    usual = {"--policy.path": checkpoint, "--dataset.repo_id": REPO_ID, "--dataset.root": root}
    usual |= dict(flag.split("=") for flag in flags.split())
    assert main(["checkpoint", "offline-metrics", *(f"{flag}={value}" for flag, value in usual.items())]) == 1
    error = capsys.readouterr().err
    assert error.startswith("lerobot-bomb checkpoint offline-metrics: ")
    assert message in error
    assert error.count("\n") == 1


def test_an_absent_dataset_is_one_line(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dataset_metadata, "HF_LEROBOT_HOME", tmp_path)
    monkeypatch.setattr(dataset_metadata, "HF_LEROBOT_HUB_CACHE", tmp_path)
    flags = [f"--policy.path={checkpoint}", "--dataset.repo_id=test/absent"]
    assert main(["checkpoint", "offline-metrics", *flags]) == 1
    error = capsys.readouterr().err
    assert error.startswith(
        f"lerobot-bomb checkpoint offline-metrics: {tmp_path}/test/absent holds no dataset "
    )
    assert "test/absent cannot be had from the Hub (" in error
    assert error.count("\n") == 1


def edited(checkpoint: Path, folder: Path, edit: Callable[[dict[str, Any]], None]) -> Path:
    """A copy of the checkpoint with another config."""
    shutil.copytree(checkpoint, folder)
    config = json.loads((folder / "config.json").read_text())
    edit(config)
    (folder / "config.json").write_text(json.dumps(config))
    return folder


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (
            lambda config: config["output_features"]["action"].update(shape=[7]),
            "the policy has 'action' of shape (7,); dataset test/offline has (4,)",
        ),
        (
            lambda config: config["input_features"].update(
                {"observation.images.top": {"type": "VISUAL", "shape": [3, 32, 32]}}
            ),
            "the policy needs 'observation.images.top', which dataset test/offline has not",
        ),
        (
            lambda config: config.update(use_peft=True),
            "the checkpoint holds adapters; lerobot-bomb checkpoint merge",
        ),
    ],
)
def test_a_policy_that_does_not_fit_is_refused(
    edit: Callable[[dict[str, Any]], None],
    message: str,
    checkpoint: Path,
    root: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = edited(checkpoint, tmp_path / "other", edit)
    flags = [f"--policy.path={path}", f"--dataset.repo_id={REPO_ID}", f"--dataset.root={root}"]
    assert main(["checkpoint", "offline-metrics", *flags]) == 1
    assert capsys.readouterr().err.startswith(f"lerobot-bomb checkpoint offline-metrics: {message}")


def test_what_was_trained_on_validates_only_when_named_and_with_a_warning(
    checkpoint: Path, root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = [f"--policy.path={checkpoint}", f"--dataset.repo_id={REPO_ID}", f"--dataset.root={root}"]
    assert main(["checkpoint", "offline-metrics", *flags, "--val_episodes=[1,2]", "--max_frames=1"]) == 0
    assert "warning: 1 of the 2 validation episodes were trained on" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("is_there", "warnings"),
    [
        (True, ["warning: 2 of the 3 validation"]),
        (False, ["warning: not every training", "warning: 1 of the 3 validation"]),
    ],
)
def test_what_its_parent_was_trained_on_counts(
    is_there: bool,
    warnings: list[str],
    checkpoint: Path,
    root: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    parent = checkpoint if is_there else tmp_path / "gone"
    more = {"pretrained_path": str(parent), "trained_batches": 2}
    path = edited(checkpoint, tmp_path / "child", lambda config: config.update(more))
    training = json.loads((path / "train_config.json").read_text())
    training["dataset"]["episodes"] = [2]
    (path / "train_config.json").write_text(json.dumps(training))
    flags = [f"--policy.path={path}", f"--dataset.repo_id={REPO_ID}", f"--dataset.root={root}"]
    assert main(["checkpoint", "offline-metrics", *flags, "--val_episodes=1-3", "--max_frames=1"]) == 0
    told = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warning: ")]
    assert [line[: len(start)] for line, start in zip(told, warnings, strict=True)] == warnings


def test_a_checkpoint_that_does_not_say_what_it_saw_needs_the_flag(
    checkpoint: Path, root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "untold"
    shutil.copytree(checkpoint, path, ignore=shutil.ignore_patterns("train_config.json"))
    flags = [f"--policy.path={path}", f"--dataset.repo_id={REPO_ID}", f"--dataset.root={root}"]
    assert main(["checkpoint", "offline-metrics", *flags]) == 1
    assert "has no train_config.json to tell which episodes" in capsys.readouterr().err
