"""`lerobot-train` resumes as if it had never stopped, and trains a checkpoint further."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from lerobot.datasets import LeRobotDatasetMetadata
from recipes import recipe_path

from lerobot_bomb.data.record import record
from lerobot_bomb.data.recording import Recording
from lerobot_bomb.training.policy_flags import OPTIMIZERS

Run = Callable[..., None]
REPO_ID = "overfit/bomb_place"
NUM_FRAMES = 5  # three batches an epoch


def recorded(folder: Path, seed: int) -> Path:
    record(Recording(REPO_ID, episodes=1, seed=seed, image_size=64, images=True), folder / "dataset")
    return folder / "dataset"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("recorded"), seed=3)


@pytest.fixture
def losses(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Collect the loss of every step from now on."""
    from lerobot.scripts import lerobot_train

    found, update_policy = [], lerobot_train.update_policy

    def update(*args, **kwargs):
        tracker, metrics = update_policy(*args, **kwargs)
        found.append(tracker.metrics["loss"].val)
        return tracker, metrics

    monkeypatch.setattr(lerobot_train, "update_policy", update)
    return found


def weights(output_dir: Path, step: int) -> tuple[bytes, bytes]:
    """Return the weights of the policy, and the state of the optimiser."""
    folder = output_dir / "checkpoints" / f"{step:06d}"
    files = "pretrained_model/model.safetensors", "training_state/optimizer_state.safetensors"
    policy, optimizer = ((folder / file).read_bytes() for file in files)
    return policy, optimizer


@pytest.mark.one_type
@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_a_resumed_training_is_the_uninterrupted_one(
    optimizer: str, policy_type: str, stock_cli: Run, dataset: Path, losses: list[float], tmp_path: Path
) -> None:
    meta = LeRobotDatasetMetadata(REPO_ID, root=dataset)
    flags = f"--batch_size=2 --num_workers=0 --steps=4 --save_freq=2 --dataset.root={dataset}"
    flags += f" --policy.drop_n_last_frames={meta.total_frames - NUM_FRAMES} --policy.crop_fraction=0.8"
    flags += f" --policy.optimizer={optimizer}"
    whole, second = tmp_path / "whole", tmp_path / "second"
    stock_cli(
        "lerobot-train",
        f"--config_path={recipe_path('overfit', policy_type)}",
        *flags.split(),
        f"--output_dir={whole}",
    )
    shutil.copytree(whole / "checkpoints" / "000002", second / "checkpoints" / "000002")
    checkpoint = second / "checkpoints" / "000002" / "pretrained_model"
    stock_cli(
        "lerobot-train", f"--config_path={checkpoint}/train_config.json", "--resume=true",
        f"--output_dir={second}",
    )  # fmt: skip
    assert len(set(losses[:4])) == 4
    assert losses[4:] == losses[2:4]
    assert weights(second, 4) == weights(whole, 4)
    config = json.loads((second / "checkpoints" / "000004" / "pretrained_model" / "config.json").read_text())
    assert config["trained_batches"] == 4


def statistics(checkpoint: Path) -> dict[str, bytes]:
    """Return the files of a checkpoint's statistics."""
    return {path.name: path.read_bytes() for path in checkpoint.glob("*normalizer_processor.safetensors")}


@pytest.mark.one_type
def test_further_training_keeps_the_statistics_of_its_checkpoint_or_takes_the_datasets(
    policy_type: str, stock_cli: Run, dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = ["--batch_size=2", "--num_workers=0", "--steps=1", "--save_freq=1"]
    last = Path("checkpoints", "last", "pretrained_model")
    recipe = f"--config_path={recipe_path('overfit', policy_type)}"
    stock_cli("lerobot-train", recipe, *flags, f"--dataset.root={dataset}", f"--output_dir={tmp_path / 'a'}")
    before = statistics(tmp_path / "a" / last)
    assert len(before) == 2
    other = [*flags, f"--dataset.repo_id={REPO_ID}", f"--dataset.root={recorded(tmp_path, seed=4)}"]
    for name, keeps in (("kept", "true"), ("new", "false")):
        stock_cli(
            "lerobot-train", f"--policy.path={tmp_path / 'a' / last}", *other,
            f"--policy.keep_statistics={keeps}", f"--output_dir={tmp_path / name}",
        )  # fmt: skip
        assert (statistics(tmp_path / name / last) == before) == (name == "kept")
        assert capsys.readouterr().err.count("--policy.keep_statistics=true keeps its own") == (name == "new")


@pytest.mark.one_type
def test_without_a_checkpoint_there_are_no_statistics_to_keep(
    policy_type: str, stock_cli: Run, dataset: Path, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=r"keep_statistics=true needs --policy\.path"):
        stock_cli(
            "lerobot-train", f"--config_path={recipe_path('overfit', policy_type)}",
            f"--dataset.root={dataset}", "--policy.keep_statistics=true", f"--output_dir={tmp_path / 'x'}",
        )  # fmt: skip
