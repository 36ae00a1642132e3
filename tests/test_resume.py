"""`lerobot-train --resume=true` goes on as if it had never stopped."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from lerobot.datasets import LeRobotDatasetMetadata
from recipes import recipe_path

from lerobot_bomb.data.record import record
from lerobot_bomb.data.recording import Recording

Run = Callable[..., None]
REPO_ID = "overfit/bomb_place"
NUM_FRAMES = 5  # three batches an epoch


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("recorded") / "dataset"
    record(Recording(REPO_ID, episodes=1, seed=3, image_size=64, images=True), root)
    return root


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
def test_a_resumed_training_is_the_uninterrupted_one(
    policy_type: str, stock_cli: Run, dataset: Path, losses: list[float], tmp_path: Path
) -> None:
    meta = LeRobotDatasetMetadata(REPO_ID, root=dataset)
    flags = f"--batch_size=2 --num_workers=0 --steps=4 --save_freq=2 --dataset.root={dataset}"
    flags += f" --policy.drop_n_last_frames={meta.total_frames - NUM_FRAMES} --policy.crop_fraction=0.8"
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
