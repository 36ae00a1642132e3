"""`lerobot-bomb convert libero-hdf5`: images turned, actions paired, tasks named; the same after a kill."""

import json
import os
import shutil
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset
from libero_cases import BEFORE, INSTRUCTION, REPO_ID, SUITE, TASK, Demonstration, write_file

from lerobot_bomb.checkpoints.libero_orientation import images_of_task
from lerobot_bomb.commands import main as cli
from lerobot_bomb.data import blocks, resumable
from lerobot_bomb.data.facts import DatasetFacts
from lerobot_bomb.data.kept_blocks import finished_blocks
from lerobot_bomb.data.libero_conversion import KEYS, convert_libero
from lerobot_bomb.data.libero_hdf5 import instruction, noops

pytest.importorskip("h5py")


@pytest.fixture(scope="module")
def demonstrations() -> list[Demonstration]:
    return [Demonstration.drawn(seed, num_actions=6 + seed) for seed in range(3)]


@pytest.fixture(scope="module")
def source(demonstrations: list[Demonstration], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_file(tmp_path_factory.mktemp("source") / f"{TASK}_demo.hdf5", demonstrations)


@pytest.fixture(scope="module")
def converted(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Convert with images, through the command line, two episodes a block."""
    root = tmp_path_factory.mktemp("converted") / "x"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(resumable, "BLOCK_EPISODES", 2)
        flags = [f"--repo_id={REPO_ID}", f"--root={root}", "--images"]
        assert cli.main(["convert", "libero-hdf5", str(source), *flags]) == 0
    assert list(root.parent.iterdir()) == [root]
    return root


def rows_of(root: Path) -> Any:
    dataset: Any = LeRobotDataset(REPO_ID, root=root, video_backend="pyav")
    return dataset.hf_dataset.with_format(None)


def pixels(row: Any) -> list[np.ndarray]:
    return [np.asarray(row[key]) for key in KEYS]


def test_every_action_stands_beside_the_observation_before_it(
    converted: Path, demonstrations: list[Demonstration]
) -> None:
    rows = iter(rows_of(converted))
    for number, episode in enumerate(demonstrations):
        # the published files hold no observation of before the first action
        for moment in range(1, len(episode.actions)):
            row = next(rows)
            assert (row["episode_index"], row["frame_index"]) == (number, moment - 1)
            np.testing.assert_array_equal(np.float32(row["action"]), np.float32(episode.actions[moment]))
            state = np.concatenate([episode.poses[moment], episode.fingers[moment]])
            np.testing.assert_array_equal(np.float32(row["observation.state"]), np.float32(state))
            for image, camera in zip(pixels(row), episode.images, strict=True):
                np.testing.assert_array_equal(image, np.rot90(camera[moment], 2))
    assert next(rows, None) is None


def test_the_features_are_those_of_the_environment(converted: Path) -> None:
    info = json.loads((converted / "meta" / "info.json").read_text())
    features = info["features"]
    assert (info["fps"], info["robot_type"]) == (20, "panda")
    assert {key: features[key]["shape"] for key in (*KEYS, "observation.state", "action")} == {
        "observation.images.image": [64, 64, 3],
        "observation.images.image2": [64, 64, 3],
        "observation.state": [8],
        "action": [7],
    }
    assert features["action"]["names"] == ["x", "y", "z", "rx", "ry", "rz", "gripper"]


def test_the_task_is_what_lerobot_eval_says(converted: Path) -> None:
    dataset: Any = LeRobotDataset(REPO_ID, root=converted, video_backend="pyav")
    assert {dataset[index]["task"] for index in range(len(dataset))} == {INSTRUCTION}


def test_the_task_of_a_scene_is_without_its_name() -> None:
    assert instruction("KITCHEN_SCENE10_close_the_top_drawer") == "close the top drawer"
    assert instruction("LIVING_ROOM_SCENE2_pick_up_the_milk") == "pick up the milk"


def test_a_dataset_says_how_its_policies_are_evaluated_and_where_an_episode_is_from(converted: Path) -> None:
    size = ["--env.observation_height=64", "--env.observation_width=64"]
    assert DatasetFacts.read(converted).eval_flags() == ["--env.type=libero", f"--env.task={SUITE}", *size]
    dataset: Any = LeRobotDataset(REPO_ID, root=converted, video_backend="pyav")
    assert dataset.meta.episodes["libero/file"] == [f"{TASK}_demo.hdf5"] * 3
    assert dataset.meta.episodes["libero/demo"] == ["demo_0", "demo_1", "demo_2"]


def test_videos_are_the_default(source: Path, demonstrations: list[Demonstration], tmp_path: Path) -> None:
    assert convert_libero(source, REPO_ID, tmp_path / "x").num_frames == 5 + 6 + 7
    dataset: Any = LeRobotDataset(REPO_ID, root=tmp_path / "x", video_backend="pyav")
    image = dataset[2][KEYS[0]].numpy().transpose(1, 2, 0) * 255
    assert np.abs(image - np.rot90(demonstrations[0].images[0][3], 2)).mean() < 10
    assert np.abs(image - demonstrations[0].images[0][3]).mean() > 50


def test_a_folder_is_converted_file_by_file(demonstrations: list[Demonstration], tmp_path: Path) -> None:
    names = ("b_task", "KITCHEN_SCENE3_a_task")
    for name, episode in zip(names, demonstrations, strict=False):
        write_file(tmp_path / "suite" / f"{name}_demo.hdf5", [episode], task=name)
    assert convert_libero(tmp_path / "suite", REPO_ID, tmp_path / "x", images=True).num_episodes == 2
    dataset: Any = LeRobotDataset(REPO_ID, root=tmp_path / "x", video_backend="pyav")
    assert [dataset[0]["task"], dataset[len(dataset) - 1]["task"]] == ["a task", "b task"]


def test_demonstrations_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    episodes = [Demonstration.drawn(seed, num_actions=2) for seed in range(11)]
    write_file(tmp_path / "task_demo.hdf5", episodes)
    convert_libero(tmp_path / "task_demo.hdf5", REPO_ID, tmp_path / "x", images=True)
    actions = np.array([row["action"] for row in rows_of(tmp_path / "x")], np.float32)
    np.testing.assert_array_equal(actions, np.array([episode.actions[1] for episode in episodes], np.float32))


def test_observations_of_before_the_actions_are_recognised(
    demonstrations: list[Demonstration], tmp_path: Path
) -> None:
    """Check copies that were run again, such as OpenVLA's, which name neither task nor convention."""
    file = write_file(tmp_path / f"{TASK}_demo.hdf5", demonstrations[:1], observed=BEFORE)
    assert convert_libero(file, REPO_ID, tmp_path / "x", images=True).num_frames == 6
    rows = rows_of(tmp_path / "x")
    for moment, row in enumerate(rows):
        np.testing.assert_array_equal(
            np.float32(row["action"]), np.float32(demonstrations[0].actions[moment])
        )
        np.testing.assert_array_equal(pixels(row)[1], np.rot90(demonstrations[0].images[1][moment], 2))
    dataset: Any = LeRobotDataset(REPO_ID, root=tmp_path / "x", video_backend="pyav")
    assert dataset[0]["task"] == INSTRUCTION
    assert DatasetFacts.read(tmp_path / "x").eval_flags() == [
        "--env.type=libero",
        "--env.observation_height=64",
        "--env.observation_width=64",
    ]


def stored_as(convention: str, image: np.ndarray) -> np.ndarray:
    return {"opengl": image, "opencv": image[::-1], "lerobot": image[::-1, ::-1]}[convention]


@pytest.mark.parametrize(
    ("convention", "told_by"),
    [("opencv", "file"), ("opengl", "flag"), ("opencv", "flag"), ("lerobot", "flag")],
)
def test_images_end_in_one_orientation_however_they_were_stored(
    convention: str, told_by: str, demonstrations: list[Demonstration], tmp_path: Path
) -> None:
    images = [
        np.stack([stored_as(convention, image) for image in camera]) for camera in demonstrations[0].images
    ]
    stored = replace(demonstrations[0], images=(images[0], images[1]))
    said = {"file": convention, "flag": "opencv" if convention == "opengl" else "opengl"}[told_by]
    file = write_file(tmp_path / f"{TASK}_demo.hdf5", [stored], macros_image_convention=said)
    flag = convention if told_by == "flag" else None
    convert_libero(file, REPO_ID, tmp_path / "x", images=True, image_convention=flag)
    np.testing.assert_array_equal(
        pixels(rows_of(tmp_path / "x")[0])[0], np.rot90(demonstrations[0].images[0][1], 2)
    )


def test_noops_are_frames_in_which_nothing_is_told_to_move() -> None:
    actions = np.zeros((6, 7))
    actions[:, 6] = [-1, -1, 1, 1, 1, -1]
    actions[3, 0] = 0.5
    # the first moves nothing, nor does the second; the third closes, the fourth moves, the fifth repeats
    assert noops(actions).tolist() == [True, True, True, False, True, False]


def test_noops_are_kept_unless_the_flag_is_given(demonstrations: list[Demonstration], tmp_path: Path) -> None:
    actions = demonstrations[0].actions.copy()
    actions[2:4, :6] = 0
    actions[2:4, 6] = actions[1, 6]
    file = write_file(tmp_path / f"{TASK}_demo.hdf5", [replace(demonstrations[0], actions=actions)])
    assert convert_libero(file, REPO_ID, tmp_path / "all", images=True).num_frames == 5
    assert convert_libero(file, REPO_ID, tmp_path / "x", images=True, skip_noops=True).num_frames == 3
    left = np.array([row["action"] for row in rows_of(tmp_path / "x")], np.float32)
    np.testing.assert_array_equal(left, np.float32(actions[[1, 4, 5]]))


def contents(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def convert_and_die(source: Path, root: Path, call: int) -> None:
    """Run the conversion in a child that is killed while it writes an episode."""
    pid = os.fork()
    if pid == 0:
        signal.alarm(60)  # a child that hangs fails the test
        write, calls = blocks._write_episode, iter(range(99))

        def die_at_call(*args: Any) -> None:
            if next(calls) == call:
                os.kill(os.getpid(), signal.SIGKILL)
            write(*args)

        try:
            blocks._write_episode = die_at_call
            convert_libero(source, REPO_ID, root, resume=root.with_name("x.conversion").exists(), images=True)
        finally:
            os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == -signal.SIGKILL


@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_a_killed_conversion_resumes_to_the_same_bytes(
    source: Path, converted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(resumable, "BLOCK_EPISODES", 2)  # as in the dataset
    convert_and_die(source, tmp_path / "x", call=2)
    assert list(tmp_path.iterdir()) == [tmp_path / "x.conversion"]
    assert [path.name for path in finished_blocks(tmp_path / "x.conversion")] == ["block-00000"]
    assert convert_libero(source, REPO_ID, tmp_path / "x", resume=True, images=True).num_episodes == 3
    assert contents(tmp_path / "x") == contents(converted)
    assert list(tmp_path.iterdir()) == [tmp_path / "x"]


def test_resume_refuses_another_source_and_other_flags(
    source: Path, converted: Path, demonstrations: list[Demonstration], tmp_path: Path
) -> None:
    other = write_file(tmp_path / source.name, demonstrations[::-1])
    with pytest.raises(
        ValueError, match=r"--resume: the conversion in .* differs in source='libero-hdf5 \w{64}' "
    ):
        convert_libero(other, REPO_ID, converted, resume=True, images=True)
    with pytest.raises(ValueError, match=r"differs in images=False \(it has True\)"):
        convert_libero(source, REPO_ID, converted, resume=True)
    before = contents(converted)
    assert convert_libero(source, REPO_ID, converted, resume=True, images=True).num_frames == 18
    assert contents(converted) == before


def test_images_of_a_training_are_read_where_all_of_an_episode_is_here(
    converted: Path, demonstrations: list[Demonstration], tmp_path: Path
) -> None:
    """A dataset that was streamed has its metadata here and no frames: then none are fetched."""
    images = images_of_task(converted, KEYS[0], INSTRUCTION)
    frames = np.concatenate([episode.images[0][1:-1, ::-1, ::-1] for episode in demonstrations])
    assert images is not None and len(images) <= len(frames)
    assert all((frames == image).all(axis=(1, 2, 3)).any() for image in images)
    assert images_of_task(converted, KEYS[0], "another task") is None
    assert images_of_task(converted, "observation.images.another", INSTRUCTION) is None
    streamed = tmp_path / "streamed"
    shutil.copytree(converted, streamed, ignore=shutil.ignore_patterns("data"))
    assert images_of_task(streamed, KEYS[0], INSTRUCTION) is None
