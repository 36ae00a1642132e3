"""`lerobot-bomb checkpoint init` writes what `lerobot-train --policy.path` starts from."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_bomb.checkpoints.folder import load_processors, read_config
from lerobot_bomb.commands.main import main
from lerobot_bomb.data.record import record
from lerobot_bomb.data.recording import Recording

Run = Callable[..., None]
REPO_ID = "test/init"
SMALL = {
    "fdvla": "--policy.image_size=56 --policy.head_dim=32 --policy.dualmod_dim=16 --policy.dtype=float32",
    "spatialvla_grid": "--policy.depth_source=none",
    "vla0_smol": "--policy.dtype=float32",
}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("recorded") / "dataset"
    record(Recording(REPO_ID, episodes=1, seed=3, image_size=32, images=True), root)
    return root


@pytest.fixture
def flags(dataset: Path, tmp_path: Path) -> list[str]:
    return [f"--dataset.repo_id={REPO_ID}", f"--dataset.root={dataset}", f"--output={tmp_path / 'base'}"]


def weights_after_a_step(run: Run, output_dir: Path, flags: list[str]) -> bytes:
    own = f"--steps=1 --batch_size=2 --num_workers=0 --output_dir={output_dir}"
    run("lerobot-train", *own.split(), *flags)
    return (output_dir / "checkpoints" / "last" / "pretrained_model" / "model.safetensors").read_bytes()


@pytest.mark.one_type
def test_a_base_is_what_training_from_scratch_starts_from(
    policy_type: str, flags: list[str], dataset: Path, stock_cli: Run, tmp_path: Path
) -> None:
    own = f"--policy.type={policy_type} --policy.vlm_model_name=nano --policy.device=cpu"
    own = f"{own} --policy.chunk_size=3 --policy.n_action_steps=2 {SMALL[policy_type]}".split()
    assert main(["checkpoint", "init", *own, *flags]) == 0
    base = tmp_path / "base"
    config, stats = read_config(base, None), LeRobotDatasetMetadata(REPO_ID, root=dataset).stats
    assert set(config.input_features or {}) >= {"observation.images.wrist", "observation.state"}
    (normaliser,) = (step for step in load_processors(config)[0].steps if hasattr(step, "stats"))
    assert stats is not None
    torch.testing.assert_close(
        torch.as_tensor(vars(normaliser)["stats"]["action"]["max"]),
        torch.as_tensor(stats["action"]["max"]).float(),
    )
    once = weights_after_a_step(stock_cli, tmp_path / "once", [f"--policy.path={base}", *flags[:2]])
    assert once == weights_after_a_step(stock_cli, tmp_path / "fresh", [*own, *flags[:2]])


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ("", "--policy.type is missing; choose one of: "),
        ("--policy.type=fdvla --env.type=bomb", "unrecognized arguments: --env.type=bomb"),
        ("--policy.type=fdvla --policy.head_dim=0", "--policy.head_dim=0 must be at least 1"),
        ("--policy.type=fdvla --policy.head_dims=8", "unrecognized arguments: --policy.head_dims=8"),
        ("--policy.type=bomb_expert", "--policy.type=bomb_expert has nothing to train"),
    ],
)
def test_a_wrong_flag_is_named(
    own: str, message: str, flags: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["checkpoint", "init", *own.split(), *flags]) == 1
    assert capsys.readouterr().err.startswith(f"lerobot-bomb checkpoint init: {message}")
    assert not (tmp_path / "base").exists()


def test_a_folder_is_not_written_over(
    flags: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "base").mkdir()
    assert main(["checkpoint", "init", "--policy.type=vla0_smol", *flags]) == 1
    assert "exists already; name a new folder" in capsys.readouterr().err
