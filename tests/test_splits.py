from pathlib import Path
from typing import Any

import pytest
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.datasets.factory import make_train_eval_datasets
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.utils.constants import HF_LEROBOT_HOME

from lerobot_bomb.checkpoints.training import dataset_of
from lerobot_bomb.data.record import record
from lerobot_bomb.data.recording import Recording
from lerobot_bomb.evaluation.splits import Split, make_split, parse_episodes, trained_episodes

REPO_ID = "test/splits"


@pytest.fixture(scope="module")
def meta(tmp_path_factory: pytest.TempPathFactory) -> LeRobotDatasetMetadata:
    root = tmp_path_factory.mktemp("splits") / "dataset"
    record(Recording(REPO_ID, episodes=5, seed=3, image_size=32, fps=2, images=True, task_ids=(7,)), root)
    return LeRobotDatasetMetadata(REPO_ID, root=root)


@pytest.mark.parametrize(
    ("text", "episodes"),
    [("[180,181]", [180, 181]), ("8-11", [8, 9, 10, 11]), ("[5, 0-2]", [0, 1, 2, 5]), ("7", [7])],
)
def test_spellings_of_episodes(text: str, episodes: list[int]) -> None:
    assert parse_episodes("--val_episodes", text, num_episodes=200) == episodes


@pytest.mark.parametrize("text", ["", "[]", "3-1", "a", "1..4", "-3", "[1,]"])
def test_other_spellings_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="give numbers and ranges"):
        parse_episodes("--val_episodes", text, num_episodes=200)


@pytest.mark.parametrize(("text", "last"), [("[2,4]", "4"), ("[0-99999999999]", "99999999999")])
def test_episodes_that_do_not_exist_are_refused_before_a_range_fills_the_memory(text: str, last: str) -> None:
    with pytest.raises(
        ValueError, match=rf"--val_episodes=.*: the dataset has the episodes 0\.\.3, not {last}"
    ):
        parse_episodes("--val_episodes", text, num_episodes=4)


@pytest.mark.parametrize(
    ("trained", "train", "validation", "expected"),
    [
        ([0, 1], None, None, Split([0, 1], [2, 3], [])),
        ([0, 1], [0], None, Split([0], [2, 3], [])),  # what was trained on never validates by default
        ([0, 1], None, [1, 3], Split([0], [1, 3], [1])),
        (None, None, None, Split([], [0, 1, 2, 3], [])),  # another dataset than the training one
        (None, [3], None, Split([3], [0, 1, 2], [])),
    ],
)
def test_defaults_of_the_split(
    trained: list[int] | None, train: list[int] | None, validation: list[int] | None, expected: Split
) -> None:
    assert make_split(4, trained, train, validation) == expected


@pytest.mark.parametrize(
    ("train", "validation", "message"),
    [
        (None, None, "none is held out; name some with --val_episodes"),
        ([0, 1], [1, 2], r"both name the episodes \[1\]"),
    ],
)
def test_splits_that_are_refused(train: list[int] | None, validation: list[int] | None, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_split(4, [0, 1, 2, 3], train, validation)


@pytest.mark.parametrize(
    ("episodes", "eval_split", "expected"),
    # instructions of the five episodes: a b a c b; of each the last ceil(half) are held out
    [(None, 0.0, [0, 1, 2, 3, 4]), ([0, 2, 3], 0.0, [0, 2, 3]), (None, 0.5, [0, 1]), ([0, 2, 3], 0.4, [0])],
)
def test_trained_episodes_are_those_that_lerobot_trains_on(
    episodes: list[int] | None, eval_split: float, expected: list[int], meta: LeRobotDatasetMetadata
) -> None:
    dataset = DatasetConfig(REPO_ID, root=str(meta.root), episodes=episodes, eval_split=eval_split)
    config = TrainPipelineConfig(dataset=dataset, policy=ACTConfig(device="cpu"))
    dataset_of_lerobot: Any = make_train_eval_datasets(config)[0]
    lerobots = dataset_of_lerobot.episodes
    assert sorted(range(5) if lerobots is None else lerobots) == expected
    told = {"repo_id": REPO_ID, "root": str(meta.root), "episodes": episodes, "eval_split": eval_split}
    assert trained_episodes({"dataset": told}, meta) == expected


def test_another_dataset_was_not_trained_on(meta: LeRobotDatasetMetadata, tmp_path: Path) -> None:
    def told(repo_id: str, root: Path) -> dict[str, Any]:
        return {"dataset": {"repo_id": repo_id, "root": str(root), "episodes": [1]}}

    assert trained_episodes(told("test/other", meta.root), meta) is None
    assert trained_episodes(told(REPO_ID, tmp_path), meta) is None
    assert trained_episodes({}, meta) is None
    assert trained_episodes(told(REPO_ID, tmp_path / "of_another_machine"), meta) == [1]


def test_a_dataset_with_fewer_episodes_than_were_trained_on_is_refused(meta: LeRobotDatasetMetadata) -> None:
    told = {"repo_id": REPO_ID, "root": str(meta.root), "episodes": [4, 5, 6]}
    with pytest.raises(ValueError, match=r"trained on the episodes \[5, 6\] of test/splits, .* only 0\.\.4"):
        trained_episodes({"dataset": told}, meta)


def test_a_dataset_without_a_folder_of_its_own_lies_where_lerobot_keeps_it() -> None:
    assert dataset_of({"dataset": {"repo_id": "me/x", "root": None}}) == HF_LEROBOT_HOME / "me" / "x"
    assert dataset_of({"dataset": {"repo_id": "me/x", "root": "data/x"}}) == Path("data/x")
    assert dataset_of({}) is None
