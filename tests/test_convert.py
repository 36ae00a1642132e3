"""`lerobot-bomb convert pusht-zarr` on the real demonstrations: exact, and the same after a kill."""

import json
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset
from pusht_cases import NUM_EPISODES, REPO_ID, ZARR, Demonstrations

from lerobot_bomb.data import blocks, resumable
from lerobot_bomb.data.kept_blocks import finished_blocks
from lerobot_bomb.data.pusht_conversion import convert_pusht

CHUNK_SIZE = 10  # actions


def contents(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def check_equal(root: Path, expected: Demonstrations) -> None:
    """Compare every stored value."""
    dataset = LeRobotDataset(REPO_ID, root=root, video_backend="pyav")
    rows: Any = dataset.hf_dataset.with_format(None)
    assert len(rows) == len(expected.actions)
    np.testing.assert_array_equal(np.float32(rows["action"][:]), expected.actions)
    np.testing.assert_array_equal(np.float32(rows["observation.state"][:]), expected.states[:, :2])
    starts = [0, *expected.ends]
    for episode in range(len(expected.ends)):
        steps = range(starts[episode], starts[episode + 1])
        assert rows["episode_index"][steps.start : steps.stop] == [episode] * len(steps)
        assert rows["frame_index"][steps.start : steps.stop] == list(range(len(steps)))
        images = np.stack(
            [np.asarray(image) for image in rows[steps.start : steps.stop]["observation.image"]]
        )
        np.testing.assert_array_equal(images, expected.images[steps.start : steps.stop])


def test_every_frame_state_and_action_comes_back_exactly(
    pusht_dataset: Path, pusht_demonstrations: Demonstrations
) -> None:
    check_equal(pusht_dataset, pusht_demonstrations)


def test_the_features_are_those_of_the_environment(pusht_dataset: Path) -> None:
    info = json.loads((pusht_dataset / "meta" / "info.json").read_text())
    assert info["fps"] == 10 and info["total_episodes"] == NUM_EPISODES
    features = {
        key: (info["features"][key]["dtype"], info["features"][key]["shape"]) for key in info["features"]
    }
    assert features["observation.image"] == ("image", [96, 96, 3])
    assert features["observation.state"] == features["action"] == ("float32", [2])
    own = {"observation.image", "observation.state", "action"}
    assert set(features) - own == {"timestamp", "frame_index", "episode_index", "index", "task_index"}


def test_a_policy_gets_frames_and_chunks_of_actions(
    pusht_dataset: Path, pusht_demonstrations: Demonstrations
) -> None:
    deltas = {"action": [step / 10 for step in range(CHUNK_SIZE)]}
    dataset = LeRobotDataset(REPO_ID, root=pusht_dataset, delta_timestamps=deltas, video_backend="pyav")
    for index in (
        0,
        5,
        pusht_demonstrations.ends[0] - 4,
        pusht_demonstrations.ends[0],
        pusht_demonstrations.ends[-1] - 1,
    ):
        item: Any = dataset[int(index)]
        end = pusht_demonstrations.ends[pusht_demonstrations.ends > index][0]
        steps = np.minimum(np.arange(index, index + CHUNK_SIZE), end - 1)
        np.testing.assert_array_equal(item["action"], pusht_demonstrations.actions[steps])
        assert item["action_is_pad"].tolist() == [index + k >= end for k in range(CHUNK_SIZE)]
        pixels = item["observation.image"].numpy().transpose(1, 2, 0)
        np.testing.assert_array_equal(np.round(pixels * 255), pusht_demonstrations.images[index])
        assert item["task"] == ""


def test_the_instruction_can_be_chosen(pusht_zarr: Path, tmp_path: Path) -> None:
    convert_pusht(pusht_zarr, REPO_ID, tmp_path / "x", task="Push the block.")
    dataset: Any = LeRobotDataset(REPO_ID, root=tmp_path / "x", video_backend="pyav")
    assert dataset[200]["task"] == "Push the block."


def convert_and_die(source: Path, root: Path, name: str, call: int) -> None:
    """Run the conversion in a child that is killed at a call of a function of `blocks`."""
    pid = os.fork()
    if pid == 0:
        signal.alarm(60)  # a child that hangs fails the test
        function, calls = getattr(blocks, name), iter(range(99))

        def die_at_call(*args: Any, **options: Any) -> Any:
            if next(calls) == call:
                os.kill(os.getpid(), signal.SIGKILL)
            return function(*args, **options)

        try:
            setattr(blocks, name, die_at_call)
            convert_pusht(source, REPO_ID, root, resume=root.with_name("x.conversion").exists())
        finally:
            os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == -signal.SIGKILL


@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_a_killed_conversion_resumes_to_the_same_bytes(
    pusht_zarr: Path, pusht_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(resumable, "BLOCK_EPISODES", 2)  # as in the dataset
    root, folder = tmp_path / "x", tmp_path / "x.conversion"
    for name, call, kept in (
        ("_write_episode", 1, []),  # while it writes the first block
        ("_write_episode", 2, ["block-00000"]),  # the second
        ("aggregate_datasets", 0, ["block-00000", "block-00001"]),  # before it merges them
    ):
        convert_and_die(pusht_zarr, root, name, call)
        assert list(tmp_path.iterdir()) == [folder]
        assert [path.name for path in finished_blocks(folder)] == kept
    assert convert_pusht(pusht_zarr, REPO_ID, root, resume=True).num_episodes == NUM_EPISODES
    assert contents(root) == contents(pusht_dataset)
    assert list(tmp_path.iterdir()) == [root]


def test_resume_on_a_complete_conversion_changes_nothing(pusht_zarr: Path, pusht_dataset: Path) -> None:
    before = contents(pusht_dataset)
    assert convert_pusht(pusht_zarr, REPO_ID, pusht_dataset, resume=True).num_frames == 420
    assert contents(pusht_dataset) == before


@pytest.mark.long
def test_all_demonstrations_come_back_exactly(shared_data: Path, tmp_path: Path) -> None:
    assert convert_pusht(shared_data / ZARR, REPO_ID, tmp_path / "x").num_frames == 25650
    check_equal(tmp_path / "x", Demonstrations.read(shared_data / ZARR, range(206)))
