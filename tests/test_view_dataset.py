"""`lerobot-bomb view --dataset`: recorded frames on a sheet and in a video."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

from lerobot_bomb.commands.main import main
from lerobot_bomb.viewing.recorded import LABEL_WIDTH, TILE_HEIGHT, ViewedDataset
from lerobot_bomb.viewing.sheet import GAP, Sheet

NUM_EPISODES, LENGTH, FPS = 4, 5, 10
SIZE = 32
WORKSPACE, WRIST = "observation.images.workspace", "observation.images.wrist"


def grey(episode: int, frame: int, camera: int) -> int:
    """Return the brightness that fills an image."""
    return 40 * episode + 8 * frame + 3 * camera + 20


def image_of(value: int) -> np.ndarray:
    return np.full((SIZE, SIZE, 3), value, np.uint8)


def write_video(path: Path, camera: int) -> None:
    path.parent.mkdir(parents=True)
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx264", rate=FPS, options={"crf": "1", "g": "4"})
        stream.width, stream.height, stream.pix_fmt = SIZE, SIZE, "yuv420p"
        for episode in range(NUM_EPISODES):
            for frame in range(LENGTH):
                values = image_of(grey(episode, frame, camera))
                file.mux(stream.encode(av.VideoFrame.from_ndarray(values, "rgb24")))
        file.mux(stream.encode())


def png(values: np.ndarray, folder: Path) -> bytes:
    path = folder / "image.png"
    Image.fromarray(values).save(path)
    return path.read_bytes()


def write_dataset(root: Path, dtype: str) -> Path:
    """Write a LeRobotDataset v3 of grey frames, as any other program may write one."""
    (root / "meta" / "episodes" / "chunk-000").mkdir(parents=True)
    features = {name: {"dtype": dtype, "shape": [SIZE, SIZE, 3]} for name in (WORKSPACE, WRIST)}
    info = {
        "codebase_version": "v3.0", "fps": FPS, "total_episodes": NUM_EPISODES, "total_tasks": 1,
        "total_frames": NUM_EPISODES * LENGTH, "features": features,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
    }  # fmt: skip
    (root / "meta" / "info.json").write_text(json.dumps(info))
    numbers = np.arange(NUM_EPISODES)
    episodes = {
        "episode_index": numbers, "length": [LENGTH] * NUM_EPISODES,
        "tasks": [[f"Task {number}."] for number in numbers],
        "dataset_from_index": numbers * LENGTH, "dataset_to_index": (numbers + 1) * LENGTH,
        "data/chunk_index": [0] * NUM_EPISODES, "data/file_index": [0] * NUM_EPISODES,
    }  # fmt: skip
    rows = [(episode, frame) for episode in range(NUM_EPISODES) for frame in range(LENGTH)]
    table: dict[str, list[Any]] = {
        "episode_index": [row[0] for row in rows],
        "frame_index": [row[1] for row in rows],
    }
    for camera, name in enumerate((WORKSPACE, WRIST)):
        if dtype == "video":
            write_video(root / "videos" / name / "chunk-000" / "file-000.mp4", camera)
            episodes |= {f"videos/{name}/{key}": [0] * NUM_EPISODES for key in ("chunk_index", "file_index")}
            episodes[f"videos/{name}/from_timestamp"] = numbers * LENGTH / FPS
            episodes[f"videos/{name}/to_timestamp"] = (numbers + 1) * LENGTH / FPS
        else:
            table[name] = [{"bytes": png(image_of(grey(*row, camera)), root), "path": None} for row in rows]
    pq.write_table(pa.table(episodes), root / "meta" / "episodes" / "chunk-000" / "file-000.parquet")
    (root / "data" / "chunk-000").mkdir(parents=True)
    pq.write_table(pa.table(table), root / "data" / "chunk-000" / "file-000.parquet")
    return root


@pytest.fixture(params=["image", "video"])
def root(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return write_dataset(tmp_path / "recorded", request.param)


def view(root: Path, *flags: str) -> int:
    return main(["view", f"--dataset={root}", *flags])


def test_a_sheet_shows_the_first_the_middle_and_the_last_frame(root: Path, tmp_path: Path) -> None:
    output = tmp_path / "x.png"
    assert view(root, "--episodes=3,1", f"--output={output}") == 0
    pixels = np.asarray(Image.open(output))
    tile = np.zeros((TILE_HEIGHT, TILE_HEIGHT, 3), np.uint8)
    sheet = Sheet("", [""] * 7, images={"3": [tile], "1": [tile]}, label_width=LABEL_WIDTH)
    assert pixels.shape == (*(sheet.tile_origin(2, 7)), 3)
    for row, episode in enumerate((3, 1)):
        for camera in range(2):
            for column, frame in enumerate((0, 2, 4)):
                y, x = sheet.tile_origin(row, 1 + 3 * camera + column)
                shown = pixels[y : y + TILE_HEIGHT, x : x + TILE_HEIGHT].astype(int)
                assert np.abs(shown - grey(episode, frame, camera)).max() <= 3


def test_all_frames_are_read_and_those_after_a_gap(root: Path) -> None:
    dataset = ViewedDataset.read(root)
    assert dataset.cameras == [WORKSPACE, WRIST]
    assert dataset.task(2) == "Task 2."
    for frames in (range(LENGTH), (1, 4)):
        shown = [image.mean() for image in dataset.images(2, WRIST, frames)]
        assert shown == pytest.approx([grey(2, frame, 1) for frame in frames], abs=3)


def test_a_video_shows_all_frames_of_the_episodes(root: Path, tmp_path: Path) -> None:
    output = tmp_path / "x.mp4"
    assert view(root, "--episodes=0,3", f"--output={output}") == 0
    with av.open(str(output)) as file:
        images = [each.to_ndarray(format="rgb24") for each in file.decode(video=0)]
    assert len(images) == 2 * LENGTH
    middle = [int(image[128, image.shape[1] // 2 - 128].mean()) for image in images]
    expected = [grey(episode, frame, 0) for episode in (0, 3) for frame in range(LENGTH)]
    assert middle == pytest.approx(expected, abs=4)


def test_without_names_the_episodes_are_spread_over_all(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert view(root, f"--output={tmp_path}") == 0
    assert capsys.readouterr().out == f"{tmp_path / 'recorded.png'}\n"
    height = Image.open(tmp_path / "recorded.png").size[1]
    assert height // (TILE_HEIGHT + GAP) == NUM_EPISODES


def change_info(**values: object) -> Callable[[Path], object]:
    def change(root: Path) -> None:
        path = root / "meta" / "info.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | values))

    return change


WRONG: dict[str, Callable[[Path], object]] = {
    "holds no meta/info.json, so it is no LeRobotDataset": lambda root: (
        root / "meta" / "info.json"
    ).unlink(),
    "is a LeRobotDataset v2.1; convert it to v3 with LeRobot first": change_info(codebase_version="v2.1"),
    "has no images: its features are action": change_info(
        features={"action": {"dtype": "float32", "shape": [4]}}
    ),
    "holds no table of episodes": lambda root: next((root / "meta").rglob("*.parquet")).unlink(),
    "file-000.parquet is missing": lambda root: next((root / "data").rglob("*.parquet")).unlink(),
}


@pytest.mark.parametrize("message", WRONG)
def test_damaged_datasets_end_in_one_clear_line(
    message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write_dataset(tmp_path / "recorded", "image")
    WRONG[message](root)
    assert view(root, f"--output={tmp_path / 'x.png'}") == 1
    error = capsys.readouterr().err.strip()
    assert message in error and len(error.splitlines()) == 1
    assert not (tmp_path / "x.png").exists()


@pytest.mark.parametrize("damage", ["missing", "truncated"])
def test_damaged_videos_end_in_one_clear_line(
    damage: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write_dataset(tmp_path / "recorded", "video")
    path = root / "videos" / WRIST / "chunk-000" / "file-000.mp4"
    if damage == "missing":
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[:200])
    assert view(root, f"--output={tmp_path / 'x.png'}") == 1
    error = capsys.readouterr().err.strip()
    assert f"{path} is {damage}" in error and len(error.splitlines()) == 1


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--episodes=0,4"], "--episodes=4: ROOT has episodes 0 to 3"),
        (["--output=x.gif"], "--output=x.gif must end in .png or .mp4, or be a folder that exists"),
        (["--seed=3"], "--seed=3 is of an episode to be run, not of --dataset; drop it"),
        (["--policy=random"], "--policy=random is of an episode to be run, not of --dataset; drop it"),
    ],
)
def test_flags_that_do_not_go_with_a_dataset(
    flags: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write_dataset(tmp_path / "recorded", "image")
    assert view(root, f"--output={tmp_path / 'new.png'}", *flags) == 1
    assert message.replace("ROOT", str(root)) in capsys.readouterr().err


def test_episodes_need_a_dataset_that_exists(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", "--episodes=0"]) == 1
    assert "--episodes=0 needs --dataset=ROOT" in capsys.readouterr().err
    assert view(tmp_path / "none") == 1
    assert "there is no such folder; give the --root of a recording" in capsys.readouterr().err
