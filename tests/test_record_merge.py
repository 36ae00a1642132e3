"""`lerobot-bomb record merge` gives the frames and statistics of LeRobot's own merge."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.aggregate import aggregate_datasets
from lerobot.utils.constants import ACTION, OBS_STATE
from small_datasets import write_dataset

from lerobot_bomb.commands.main import main
from lerobot_bomb.data.blocks import DatasetLayout, RecordedEpisode, write_block

REPO_ID = "test/merged"


def numbers(scale: int, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a state and an action of a frame."""
    return np.array([scale * frame], np.float32), np.array([scale, 2 * frame], np.float32)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Write two datasets of other values and lengths."""
    folder = tmp_path_factory.mktemp("data")
    for scale in (1, 3):
        write_dataset(folder / str(scale), partial(numbers, scale), num_frames=4 + scale)
    return [folder / "1", folder / "3"]


def read(root: Path) -> Any:
    return LeRobotDataset(REPO_ID, root)


def merge(folders: list[Path], root: Path) -> int:
    return main(["record", "merge", *map(str, folders), f"--repo_id={REPO_ID}", f"--root={root}"])


def test_the_dataset_equals_what_lerobot_merges(
    folders: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "ours.merging").mkdir()  # of a merge that was killed
    assert merge(folders, tmp_path / "ours") == 0
    assert capsys.readouterr().out.startswith("4 episodes, 24 frames: ")
    assert [path.name for path in tmp_path.iterdir()] == ["ours"]
    aggregate_datasets([REPO_ID] * 2, REPO_ID, roots=folders, aggr_root=tmp_path / "theirs")
    ours, theirs = (read(tmp_path / name) for name in ("ours", "theirs"))
    assert len(ours) == len(theirs) == 24
    for mine, other in zip(ours, theirs, strict=True):
        assert mine.keys() == other.keys() and mine["task"] == other["task"]
        assert all(torch.equal(mine[key], other[key]) for key in other.keys() - {"task"})
    for key, statistics in theirs.meta.stats.items():
        for name in ("min", "max", "mean", "std", "count"):
            assert np.allclose(ours.meta.stats[key][name], statistics[name], atol=1e-5), (key, name)


def test_what_cannot_be_merged_is_refused(
    folders: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_dataset(tmp_path / "other", partial(numbers, 1), size=16)
    refused = {
        "differ in observation.images.wrist, so": ([folders[0], tmp_path / "other"], "new"),
        "holds no meta/info.json": ([folders[0], tmp_path], "new"),
        "exists; give a new folder": (folders, "other"),
    }
    for message, (given, root) in refused.items():
        assert merge(given, tmp_path / root) == 1
        assert message in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["other"]


def write_bomb(root: Path, actions: list[float]) -> Path:
    """Write an episode for each action, all of one spec."""
    column = {"dtype": "float32", "shape": (1,), "names": ["x"]}
    layout = DatasetLayout(REPO_ID, 10, "scara", {OBS_STATE: column, ACTION: column}, use_videos=False)
    frames = [
        {OBS_STATE: np.ones(1, np.float32), ACTION: np.array([x], np.float32), "task": "go"} for x in actions
    ]
    write_block(layout, root, [RecordedEpisode([frame], {"bomb/spec": '{"seed": 0}'}) for frame in frames])
    return root


def test_episodes_are_merged_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, second = write_bomb(tmp_path / "first", [1.0]), write_bomb(tmp_path / "second", [2.0])
    assert merge([first, second], tmp_path / "both") == 0  # one seed, run by two policies
    again = tmp_path / "both" / ".." / "first"
    refused = {
        f"{first} and {again} are one dataset": [first, again],
        f"{second} and {tmp_path / 'both'} both hold episode 1 of {tmp_path / 'both'}": [
            second,
            tmp_path / "both",
        ],
    }
    for message, given in refused.items():
        assert merge(given, tmp_path / "new") == 1
        assert message in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
