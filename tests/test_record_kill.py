"""Recorders that are killed, stopped, disturbed, or run out of disk: nothing is lost, nothing doubled.

Recordings are of 3 episodes in blocks of 2, so that each has a full block and a short one.
"""

import platform
import random
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from recorder_server import TIMEOUT_S, Moment, RecorderServer

from lerobot_bomb.commands import main as cli
from lerobot_bomb.data.kept_blocks import finished_blocks
from lerobot_bomb.data.unfinished import METADATA_FILE, unfinished_folder

pytestmark = pytest.mark.skipif(platform.system() != "Linux", reason="processes are watched through /proc")

FLAGS = ("--repo_id=test/killed", "--episodes=3", "--seed=3", "--image_size=32", "--fps=5")
MODES = {"video": FLAGS, "images": (*FLAGS, "--images", "--workers=2")}
SEED, NUM_KILLS = 0, 10  # of the random moments
NOTHING = "no block of 2 episodes was finished, so nothing is kept"

# the recorder's own last steps of each stage: what a kill just before them leaves is the most delicate
STEPS = (
    "os.rename .*recording.json",
    "os.rename .*block-00000.*/block.json",
    "os.rename .*block-00000$",
    "os.rename .*block-00001.*/block.json",
    "os.rename .*/meta/bomb.json",
    "os.rename .*/dataset ",
    "os.rmdir",
)
JOINED_VIDEO = r"os.rename \S*/tmp\w+\.mp4 "  # LeRobot's temporary file takes its place


@dataclass(frozen=True)
class Reference:
    """An uninterrupted recording."""

    contents: dict[str, bytes]
    num_operations: int


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RecorderServer]:
    started = RecorderServer(tmp_path_factory.mktemp("recorders"))
    yield started
    started.close()
    assert [path.name for path in started.temporary.iterdir() if path.is_file()] == []


@pytest.fixture(scope="module")
def references(server: RecorderServer, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Reference]:
    references = {}
    for mode, flags in MODES.items():
        root = tmp_path_factory.mktemp("uninterrupted") / mode
        num_operations = len(server.record(root, *flags).operations)
        references[mode] = Reference(contents(root), num_operations)
    return references


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 8 MiB of its own."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=8m", "none", str(folder)]
    mounted = subprocess.run(command, capture_output=True, text=True)
    if mounted.returncode:
        pytest.skip(f"no file system can be mounted ({mounted.stderr.strip()}); try `unshare -rm`")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


def contents(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def resume_flag(root: Path) -> list[str]:
    return ["--resume"] if root.exists() or unfinished_folder(root).exists() else []


def check_after_kill(root: Path, blocks: dict[str, dict[str, bytes]], reference: Reference) -> None:
    """Check that finished blocks stay, and that a dataset appears whole or not at all; update `blocks`."""
    if root.exists():
        assert contents(root) == reference.contents
    else:
        now = {block.name: contents(block) for block in finished_blocks(unfinished_folder(root))}
        assert {name: now.get(name) for name in blocks} == blocks
        blocks.update(now)


@pytest.mark.long
@pytest.mark.parametrize("mode", ["video", "images"])
def test_a_recording_killed_before_each_of_its_steps_loses_nothing(
    mode: str, server: RecorderServer, references: dict[str, Reference], tmp_path: Path
) -> None:
    root, blocks = tmp_path / "x", {}
    for step in (JOINED_VIDEO, *STEPS) if mode == "video" else STEPS:
        ended = server.record(root, *MODES[mode], *resume_flag(root), moment=Moment("kill", step))
        assert ended.exit_code is None, f"never came to {step}: {ended.messages}"
        check_after_kill(root, blocks, references[mode])
    assert server.record(root, *MODES[mode], "--resume").exit_code == 0
    assert contents(root) == references[mode].contents
    assert list(tmp_path.iterdir()) == [root]


@pytest.mark.long
def test_parts_killed_before_each_of_their_steps_lose_nothing(
    server: RecorderServer, references: dict[str, Reference], tmp_path: Path
) -> None:
    """Record three episodes: one part has a block, and the join makes the last, short one."""
    root = tmp_path / "x"
    part, join = (*FLAGS, "--shard=0/1"), (*FLAGS, "--join")
    of_part = "os.rename .*recording.json", "os.rename .*block-00000.*/block.json", "os.rename .*block-00000$"
    of_join = (
        "os.rename .*block-00001$",
        "os.rename .*/meta/bomb.json",
        "os.rename .*/dataset ",
        r"os.rmdir \.recording$",
        r"os.remove \.parts/.*/lock",
        r"os.rmdir \.parts$",
    )
    for flags, steps in ((part, of_part), (join, of_join)):
        for step in steps:
            ended = server.record(root, *flags, moment=Moment("kill", step))
            assert ended.exit_code is None, f"never came to {step}: {ended.messages}"
            assert not root.exists() or contents(root) == references["video"].contents
        assert server.record(root, *flags).exit_code == 0
    assert contents(root) == references["video"].contents
    assert list(tmp_path.iterdir()) == [root]


@pytest.mark.long
@pytest.mark.parametrize("mode", ["video", "images"])
def test_a_recording_killed_at_random_moments_loses_nothing(
    mode: str, server: RecorderServer, references: dict[str, Reference], tmp_path: Path
) -> None:
    """One recording is killed again and again; when it ends before its kill, another one starts."""
    rng = random.Random(SEED)
    recording, killed = 0, []
    blocks = {}
    while len(killed) < NUM_KILLS or resume_flag(tmp_path / f"{recording}"):
        root = tmp_path / f"{recording}"
        moment = Moment("kill", count=rng.randint(1, references[mode].num_operations))
        if len(killed) == NUM_KILLS:
            moment = None
        ended = server.record(root, *MODES[mode], *resume_flag(root), moment=moment)
        if ended.exit_code is None:
            killed.append(ended.operations[-1])
            check_after_kill(root, blocks, references[mode])
        else:
            assert ended.exit_code == 0, f"after {killed}: {ended.messages}"
            assert contents(root) == references[mode].contents, f"after {killed}"
            recording += 1
            blocks = {}
    assert sorted(tmp_path.iterdir()) == sorted(tmp_path / f"{number}" for number in range(recording))


@pytest.mark.long
def test_ctrl_c_and_sigterm_say_what_is_kept(
    server: RecorderServer, references: dict[str, Reference], tmp_path: Path
) -> None:
    root, folder = tmp_path / "x", tmp_path / "x.recording"
    rng = random.Random(SEED)
    # the first comes while workers are still importing
    for action, code, count in (("Ctrl-C", 130, 1), ("terminate", 143, rng.randint(1, 80))):
        ended = server.record(root, *FLAGS, moment=Moment(action, "block-00000.tmp", count))
        assert ended.exit_code == code
        assert f"--root={root}: stopped; {NOTHING}" in ended.messages
        assert "Traceback" not in "\n".join(ended.messages)
        assert list(tmp_path.iterdir()) == []
    for action, part, code, kept in (("Ctrl-C", "block-00001.tmp", 130, 2), ("terminate", "dataset", 143, 3)):
        moment = Moment(action, part, rng.randint(1, 30))
        ended = server.record(root, *FLAGS, *resume_flag(root), moment=moment)
        assert ended.exit_code == code, ended.messages
        what = f"{kept} episodes are kept in {folder}, continue with --resume"
        assert f"--root={root}: stopped; {what}" in ended.messages
        assert "Traceback" not in "\n".join(ended.messages)
    assert server.record(root, *FLAGS, "--resume").exit_code == 0
    assert contents(root) == references["video"].contents


def test_a_second_recorder_is_refused_and_the_first_not_disturbed(
    server: RecorderServer,
    references: dict[str, Reference],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    root = tmp_path / "x"
    both = [server.start(root, *FLAGS, moment=Moment("wait", "open .*bomb.tmp")) for _ in range(2)]
    deadline = time.monotonic() + TIMEOUT_S
    while not (unfinished_folder(root) / "block-00000").exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    for flags in ([], ["--resume"]):
        assert cli.main(["record", f"--root={root}", *FLAGS, *flags]) == 1
        assert f"another process is at work in {root}.recording" in capsys.readouterr().err
    root.with_suffix(".go").touch()
    ended = sorted((recorder.wait() for recorder in both), key=lambda end: end.exit_code or 0)
    assert [end.exit_code for end in ended] == [0, 1]
    assert "another process is at work" in "\n".join(ended[1].messages)
    assert contents(root) == references["video"].contents
    assert not unfinished_folder(root).exists()


FULL = "No space left on device"
# where the disk becomes full, and how many episodes are kept
FULL_AT = {
    "video": (
        ("open .*recording.tmp", 0),
        ("os.mkdir .*block-00000.tmp/tmp", 0),
        ("os.mkdir .*block-00001.tmp/meta/episodes", 2),
        ("open .*dataset.cache.*arrow", 3),
        ("os.mkdir .*/dataset$", 3),
        ("open .*bomb.tmp", 3),
    ),
    "images": (
        ("open .*block-00001.tmp/images", 2),
        ("os.mkdir .*/dataset/data", 3),
    ),
}


@pytest.mark.parametrize("mode", ["video", pytest.param("images", marks=pytest.mark.long)])
def test_a_full_disk_is_reported_and_what_was_finished_is_kept(
    mode: str, server: RecorderServer, references: dict[str, Reference], disk: Path
) -> None:
    root, folder = disk / "x", disk / "x.recording"
    blocks = {}
    for pattern, kept in FULL_AT[mode]:
        moment = Moment("fill the disk", pattern)
        ended = server.record(root, *MODES[mode], *resume_flag(root), moment=moment)
        (disk / "filler").unlink(missing_ok=True)
        assert ended.exit_code == 1, (pattern, ended.messages)
        error = [line for line in ended.messages if FULL in line]
        what = f"{kept} episodes are kept in {folder}, continue with --resume" if kept else NOTHING
        assert len(error) == 1, ended.messages
        assert error[0].startswith(f"lerobot-bomb record: --root={root}: ")
        assert error[0].endswith(f"; {what}")
        assert "Traceback" not in "\n".join(ended.messages)
        assert not root.exists()
        assert folder.exists() == bool(kept)
        check_after_kill(root, blocks, references[mode])
        assert len(blocks) == (kept + 1) // 2
        if kept:  # what was unfinished is gone, so that the disk has room again
            assert {path.name for path in folder.iterdir()} == {"lock", "recording.json", *blocks}
    assert server.record(root, *MODES[mode], "--resume").exit_code == 0
    assert contents(root) == references[mode].contents
    assert list(disk.iterdir()) == [root]
    assert (root / METADATA_FILE).exists()
