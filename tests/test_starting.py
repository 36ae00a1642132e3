"""Starts of a training: a checkpoint on data like its own, its backbone on any other."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset
from lerobot.envs import make_env_config
from lerobot.policies.factory import make_policy, make_pre_post_processors
from policy_cases import CASES, save_checkpoint
from safetensors.torch import load_file
from small_datasets import ACTION, STATE, write_dataset
from torch.utils.data import DataLoader

from lerobot_bomb.commands.main import main

TRAINED_ON = ("workspace", "wrist")  # of 64 pixels, state and action of 4 numbers
WAY_OUT = r"lerobot-bomb checkpoint export-backbone --policy.path=\S+ --output=FOLDER, then lerobot-train"


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folders = {name: tmp_path_factory.mktemp("checkpoints") / name for name in CASES}
    for name, folder in folders.items():
        save_checkpoint(name, folder)
    return folders


@pytest.fixture(scope="module")
def datasets(tmp_path_factory: pytest.TempPathFactory) -> dict[str, LeRobotDataset]:
    folder = tmp_path_factory.mktemp("datasets")

    def write(name: str, num_states: int, num_actions: int, **options: Any) -> LeRobotDataset:
        random = np.random.default_rng(0)

        def numbers(_: int) -> tuple[np.ndarray, np.ndarray]:
            state, action = (random.uniform(-1, 1, size).astype("f4") for size in (num_states, num_actions))
            return state, action

        return write_dataset(folder / name, numbers, **{"cameras": TRAINED_ON, "size": 64, **options})

    return {
        "cameras": write("cameras", 4, 4, cameras=("front", "side")),
        "size": write("size", 4, 4, size=48),
        "state": write("state", 6, 4),
        "action": write("action", 4, 6),
        "all": write("all", 6, 7, cameras=("front",), size=48),
    }


def started_from(checkpoint: Path, dataset: LeRobotDataset) -> Any:
    """Load a policy as lerobot-train --policy.path does."""
    config = PreTrainedConfig.from_pretrained(checkpoint)
    config.pretrained_path = checkpoint
    return make_policy(config, ds_meta=dataset.meta)


def from_flags(policy_type: str, **values: Any) -> Any:
    """Make a config as --policy.type does: features are the dataset's."""
    config = CASES[policy_type].make_config()
    config.input_features = {}
    for name, value in values.items():
        setattr(config, name, value)
    return config


def loss_of(policy: Any, dataset: LeRobotDataset) -> float:
    stats: Any = dataset.meta.stats
    preprocess, _ = make_pre_post_processors(policy.config, dataset_stats=stats)
    steps = [step / dataset.fps for step in range(policy.config.chunk_size)]
    chunked = LeRobotDataset(dataset.repo_id, root=dataset.root, delta_timestamps={ACTION: steps})
    loss, _ = policy.train()(preprocess(next(iter(DataLoader(chunked, batch_size=2)))))
    return float(loss.detach())


def test_a_type_with_pretrained_path_names_the_ways(
    checkpoints: dict[str, Path], datasets: dict[str, LeRobotDataset], policy_type: str
) -> None:
    config = from_flags(policy_type, pretrained_path=checkpoints[policy_type])
    message = rf"--policy.type={policy_type} --policy.pretrained_path=\S+: .* --policy.path=\S+, .* {WAY_OUT}"
    with pytest.raises(ValueError, match=message):
        make_policy(config, ds_meta=datasets["all"].meta)


def test_other_cameras_are_told_before_lerobot_refuses_them(
    checkpoints: dict[str, Path],
    datasets: dict[str, LeRobotDataset],
    policy_type: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    with pytest.raises(ValueError, match="Feature mismatch"):
        started_from(checkpoints[policy_type], datasets["cameras"])
    (told,) = (record.getMessage() for record in caplog.records if "--rename_map" in record.getMessage())
    assert "reads observation.images.workspace, observation.images.wrist; this dataset has" in told
    assert "observation.images.front, observation.images.side. Unless --rename_map" in told
    assert f"export-backbone --policy.path={checkpoints[policy_type]}" in told


def test_images_of_another_size_are_taken(
    checkpoints: dict[str, Path], datasets: dict[str, LeRobotDataset], policy_type: str
) -> None:
    policy = started_from(checkpoints[policy_type], datasets["size"])
    assert {feature.shape for feature in policy.config.image_features.values()} == {(3, 48, 48)}


@pytest.mark.parametrize(
    ("name", "key"),
    [("fdvla", STATE), ("fdvla", ACTION), ("spatialvla_grid", ACTION)],
)
def test_dimensions_that_weights_are_made_for_are_told(
    checkpoints: dict[str, Path], datasets: dict[str, LeRobotDataset], name: str, key: str
) -> None:
    dataset = datasets["state" if key == STATE else "action"]
    message = rf"has '{key}' of shape \(4,\), this dataset has it of shape \(6,\); .* {WAY_OUT}"
    with pytest.raises(ValueError, match=message):
        started_from(checkpoints[name], dataset)


@pytest.mark.parametrize(
    ("name", "key"),
    [("vla0_smol", "state"), ("vla0_smol", "action"), ("spatialvla_grid", "state")],
)
def test_dimensions_that_are_text_are_taken(
    checkpoints: dict[str, Path], datasets: dict[str, LeRobotDataset], name: str, key: str
) -> None:
    policy = started_from(checkpoints[name], datasets[key])
    features = {**policy.config.input_features, **policy.config.output_features}
    assert features[STATE if key == "state" else ACTION].shape == (6,)
    assert 0 < loss_of(policy, datasets[key]) < 100


def test_an_environment_with_other_actions_is_told(policy_type: str, checkpoints: dict[str, Path]) -> None:
    config = PreTrainedConfig.from_pretrained(checkpoints[policy_type])
    config.pretrained_path = checkpoints[policy_type]
    with pytest.raises(ValueError, match=r"--policy\.path=\S+ acts with 4 numbers, this environment takes 2"):
        make_policy(config, env_cfg=make_env_config("pusht"))


def test_the_exported_backbone_starts_on_any_data(
    checkpoints: dict[str, Path], datasets: dict[str, LeRobotDataset], policy_type: str, tmp_path: Path
) -> None:
    checkpoint, base = checkpoints[policy_type], tmp_path / "base"
    assert main(["checkpoint", "export-backbone", f"--policy.path={checkpoint}", f"--output={base}"]) == 0
    layout = {"action_layout": "joints"} if policy_type == "spatialvla_grid" else {}
    config = from_flags(policy_type, vlm_model_name=str(base), nano_config=None, **layout)
    policy = make_policy(config, ds_meta=datasets["all"].meta)
    held, saved = policy.state_dict(), load_file(checkpoint / "model.safetensors")
    of_backbone = [name for name in saved if name.startswith("backbone.")]
    assert of_backbone and all(saved[name].equal(held[name]) for name in of_backbone)
    assert 0 < loss_of(policy, datasets["all"]) < 100
