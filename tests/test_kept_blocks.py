"""Blocks of a growing dataset that were lost or damaged before --resume.

Simulator workers import this file's head, so LeRobot is imported inside tests.
"""

import io
import json
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import av
import pytest

from lerobot_bomb.commands import main as cli
from lerobot_bomb.data import resumable
from lerobot_bomb.data.kept_blocks import damaged_blocks, find_gaps, finished_blocks
from lerobot_bomb.data.record import record
from lerobot_bomb.data.recording import Recording
from lerobot_bomb.data.unfinished import METADATA_FILE, unfinished_folder

RECORDING = Recording("test/blocks", episodes=5, seed=3, image_size=32)
FLAGS = ("--repo_id=test/blocks", "--episodes=5", "--seed=3", "--image_size=32")
VIDEO = "videos/observation.images.wrist/chunk-000/file-000.mp4"


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write blocks of 2 episodes, so that 5 take three."""
    monkeypatch.setattr(resumable, "BLOCK_EPISODES", 2)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an uninterrupted recording, x, and what there was before its merge, x.recording."""
    from lerobot_bomb.data import blocks

    folder = tmp_path_factory.mktemp("blocks")
    root = folder / "x"
    merge = blocks.merge_blocks

    def copy_and_merge(*args) -> None:
        shutil.copytree(unfinished_folder(root), folder / "copy")
        merge(*args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(resumable, "BLOCK_EPISODES", 2)
        patch.setattr(blocks, "merge_blocks", copy_and_merge)
        record(RECORDING, root)
    (folder / "copy").rename(unfinished_folder(root))
    return folder


def contents(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def packets(video: bytes) -> list[tuple[int | None, int | None, bytes]]:
    opened = av.open(io.BytesIO(video), mode="r")
    return [(packet.pts, packet.duration, bytes(packet)) for packet in opened.demux(video=0)]


def halve(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def test_lost_and_damaged_blocks_are_recorded_again_to_the_same_bytes(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root, folder = tmp_path / "x", tmp_path / "x.recording"
    shutil.copytree(recorded / "x.recording", folder)
    halve(folder / "block-00000" / VIDEO)
    kept = (folder / "block-00001" / VIDEO).stat().st_mtime_ns
    halve(folder / "block-00002" / "block.json")
    (folder / "notes.txt").write_text("mine")
    (folder / "block-by-hand").mkdir()
    assert cli.main(["record", f"--root={root}", *FLAGS, "--resume"]) == 0
    errors = capsys.readouterr().err
    assert f"{folder}/block-00000 holds a damaged {VIDEO}; its episodes are made again" in errors
    assert f"{folder}/block-00002 holds no block.json that can be read; its episodes are made again" in errors
    assert "block-00001" not in errors
    assert kept
    assert contents(root) == contents(recorded / "x")
    assert f"{folder} stays: it holds block-by-hand, notes.txt" in errors
    assert sorted(path.name for path in folder.iterdir()) == ["block-by-hand", "notes.txt"]
    assert (folder / "notes.txt").read_text() == "mine"


def test_a_lost_block_between_others_is_missed(recorded: Path, tmp_path: Path) -> None:
    folder = tmp_path / "x.recording"
    shutil.copytree(recorded / "x.recording", folder)
    (folder / "block-00001").rename(tmp_path / "lost")
    assert damaged_blocks(folder, range(3)) == {folder / "block-00001": "is missing"}
    assert find_gaps(folder, range(3)) == [range(1, 2)]
    assert find_gaps(folder, range(9)) == [range(1, 2), range(3, 9)]
    shutil.copytree(folder / "block-00000", folder / "block-00001")
    assert damaged_blocks(folder, range(3)) == {folder / "block-00001": "is block 0"}


def test_a_merge_that_loses_episodes_is_an_error_and_the_blocks_stay(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from lerobot_bomb.data import blocks

    merge: Callable = blocks.merge_blocks
    shutil.copytree(recorded / "x.recording", tmp_path / "x.recording")
    monkeypatch.setattr(
        blocks, "merge_blocks", lambda layout, folders, root: merge(layout, folders[:-1], root)
    )
    with pytest.raises(
        RuntimeError, match=r"holds 4 episodes, but meta/bomb.json says that 5 were made; 5 episodes are kept"
    ):
        record(RECORDING, tmp_path / "x", resume=True)
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("file_mb", [100, 0.001])
def test_a_merge_that_writes_each_file_once_is_lerobots(
    file_mb: float, recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from lerobot.datasets import aggregate

    from lerobot_bomb.data import blocks

    for kind in ("DATA", "VIDEO"):
        monkeypatch.setattr(aggregate, f"DEFAULT_{kind}_FILE_SIZE_IN_MB", file_mb)
    before = vars(aggregate).copy()
    layout, there = RECORDING.layout(), finished_blocks(recorded / "x.recording")
    blocks.merge_blocks(layout, there, tmp_path / "once")
    assert vars(aggregate) == before
    monkeypatch.setattr(blocks, "merged_at_once", nullcontext)
    blocks.merge_blocks(layout, there, tmp_path / "again_and_again")
    once, again = contents(tmp_path / "once"), contents(tmp_path / "again_and_again")
    assert once.keys() == again.keys()
    assert len([name for name in once if "file-" in name]) == (4 if file_mb == 100 else 12)
    for name in once:
        if name.endswith(".mp4"):  # a header says a bit rate, which a video has from how it was joined
            assert packets(once[name]) == packets(again[name])
        else:
            assert once[name] == again[name], name


@pytest.mark.parametrize("name", [VIDEO, "data/chunk-000/file-000.parquet", "meta/tasks.parquet"])
def test_a_complete_recording_with_a_truncated_file_is_no_success(
    name: str, recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "x"
    shutil.copytree(recorded / "x", root)
    halve(root / name)
    assert cli.main(["record", f"--root={root}", *FLAGS, "--resume"]) == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith(f"lerobot-bomb record: {root / name} is truncated")
    assert (root / METADATA_FILE).exists()


def test_a_link_that_leads_nowhere_is_refused_before_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "x").symlink_to(tmp_path / "nowhere")
    for resume in ([], ["--resume"]):
        assert cli.main(["record", f"--root={tmp_path / 'x'}", *FLAGS, *resume]) == 1
        assert f"--root={tmp_path / 'x'} is a link to {tmp_path}/nowhere" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["x"]


def test_a_tilde_in_a_path_is_the_home_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "x").mkdir()
    assert cli.main(["record", "--root=~/x", *FLAGS]) == 1
    assert f"--root={tmp_path}/x exists already" in capsys.readouterr().err


def test_a_camera_without_a_video_is_told(recorded: Path) -> None:
    from lerobot_bomb.data.blocks import check_encoded_frames

    root = recorded / "x"
    wrist, other = "observation.images.wrist", "observation.images.other"
    num_frames = json.loads((root / "meta/info.json").read_text())["total_frames"]
    check_encoded_frames(root, [wrist, "observation.images.workspace"], num_frames)
    with pytest.raises(RuntimeError, match=rf"the video of {other} has 0 frames instead of {num_frames}"):
        check_encoded_frames(root, [wrist, "observation.images.workspace", other], num_frames)
