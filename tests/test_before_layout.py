"""Files from before the core had folders load and act as they did: fixtures/before_layout/README.md."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset
from saved_actions import EXPECTED, actions_of, contents_of, read_dataset

from lerobot_bomb.bomb.environment import Environment
from lerobot_bomb.data.facts import DatasetFacts

FOLDER = Path(__file__).parent / "fixtures" / "before_layout"
TYPES = ("vla0_smol", "spatialvla_grid", "fdvla")
BASES = "BASES"  # in the adapters' files, the folder of their bases
# numbers that CPUs round differently; the others' actions are chosen among a few
TOLERANCES = {"fdvla": 1e-5}


@pytest.fixture(scope="module")
def dataset() -> LeRobotDataset:
    return read_dataset(FOLDER / "dataset")


@pytest.fixture(scope="module")
def expected() -> dict[str, np.ndarray]:
    with np.load(FOLDER / EXPECTED) as arrays:
        return dict(arrays)


def check_actions(name: str, checkpoint: Path, dataset: LeRobotDataset, expected: np.ndarray) -> None:
    actions = actions_of(checkpoint, dataset)
    np.testing.assert_allclose(actions, expected, rtol=0, atol=TOLERANCES.get(name, 0))


def test_a_dataset_has_the_same_contents(dataset: LeRobotDataset, expected: dict[str, np.ndarray]) -> None:
    contents = contents_of(dataset)
    assert len(contents["action"]) == len(dataset) > 0
    for key, values in contents.items():
        np.testing.assert_array_equal(values, expected[key], err_msg=key)


def test_a_dataset_tells_the_same_environment() -> None:
    cameras = ("workspace", "wrist")
    assert DatasetFacts.read(FOLDER / "dataset").environment == Environment(
        "scara", "relative", 10, 32, cameras, "1.0", "place", task_ids=()
    )


@pytest.mark.parametrize("name", TYPES)
def test_a_checkpoint_acts_the_same(
    name: str, dataset: LeRobotDataset, expected: dict[str, np.ndarray]
) -> None:
    assert len(np.unique(expected[name].reshape(-1, 4), axis=0)) > 3  # it sees
    check_actions(name, FOLDER / name, dataset, expected[name])


@pytest.mark.parametrize("name", TYPES)
def test_adapters_act_the_same(
    name: str, dataset: LeRobotDataset, expected: dict[str, np.ndarray], tmp_path: Path
) -> None:
    pytest.importorskip("peft")
    adapters = f"{name}_lora"
    assert not np.allclose(expected[adapters], expected[name], atol=1e-3)
    shutil.copytree(FOLDER / adapters, tmp_path / adapters)
    for file in (tmp_path / adapters).glob("*.json"):
        file.write_text(file.read_text().replace(BASES, str(FOLDER)))
    check_actions(name, tmp_path / adapters, dataset, expected[adapters])
