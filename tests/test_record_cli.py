"""The command `lerobot-bomb record` itself, killed and stopped at random times of its life."""

import os
import platform
import random
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
from recorder_server import MARK, TIMEOUT_S, marked_processes, wait_for_end

from lerobot_bomb.data.kept_blocks import finished_blocks
from lerobot_bomb.data.unfinished import unfinished_folder

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(platform.system() != "Linux", reason="processes are watched through /proc"),
]

COMMAND = Path(sys.executable).with_name("lerobot-bomb")
FLAGS = ("--repo_id=test/killed", "--episodes=45", "--image_size=32")  # two full blocks and a short one
MODES = {"video": FLAGS, "images": (*FLAGS, "--images", "--workers=2")}
SEED = 0  # of the random moments
START_UP_SHARE = 0.3  # of the moments; the others lie after LeRobot's import


@dataclass(frozen=True)
class Reference:
    """An uninterrupted recording."""

    contents: dict[str, bytes]
    start_up_s: float  # until the first block is begun
    writing_s: float  # from then on


@pytest.fixture(scope="module")
def references(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Reference]:
    references = {}
    for mode in MODES:
        root = tmp_path_factory.mktemp("uninterrupted") / mode
        process = start(root, mode)
        start_up_s = wait_for_block(process, root)
        begun = time.monotonic()
        assert process.wait(TIMEOUT_S) == 0
        references[mode] = Reference(contents(root), start_up_s, time.monotonic() - begun)
    return references


def start(root: Path, mode: str) -> subprocess.Popen:
    begun = root.exists() or unfinished_folder(root).exists()
    return subprocess.Popen(
        [COMMAND, "record", f"--root={root}", *MODES[mode], *(["--resume"] if begun else [])],
        stderr=root.with_suffix(".err").open("wb"),
        stdout=subprocess.DEVNULL,
        env=os.environ | {MARK: str(root)},
        start_new_session=True,
        # a job in the background starts ignoring Ctrl-C, and its children with it
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def contents(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def wait_for_block(process: subprocess.Popen, root: Path) -> float:
    """Wait until a block or the merge is begun, or the process ends; return the seconds."""
    started = time.monotonic()
    folder = unfinished_folder(root)
    while process.poll() is None and time.monotonic() - started < TIMEOUT_S:
        if folder.exists() and any(path.suffix in (".tmp", ".cache") for path in folder.glob("[bd]*")):
            break
        time.sleep(0.005)
    return time.monotonic() - started


def wait_for_moment(process: subprocess.Popen, root: Path, reference: Reference, rng: random.Random) -> None:
    """Wait until a random time of the process's life; it may end before."""
    early = rng.random() < START_UP_SHARE
    delay_s = rng.uniform(0, reference.start_up_s if early else reference.writing_s)
    if not early:
        wait_for_block(process, root)
    try:
        process.wait(delay_s)
    except subprocess.TimeoutExpired:
        return


def check_blocks(root: Path, blocks: dict[str, dict[str, bytes]]) -> None:
    """Check that finished blocks stay as they are; update `blocks`."""
    now = {block.name: contents(block) for block in finished_blocks(unfinished_folder(root))}
    assert {name: now.get(name) for name in blocks} == blocks
    blocks.update(now)


@pytest.mark.parametrize("mode", MODES)
def test_ten_kills_lose_nothing(mode: str, references: dict[str, Reference], tmp_path: Path) -> None:
    """One recording is killed again and again; when it ends before its kill, another one starts."""
    rng = random.Random(SEED)
    num_kills, recording, blocks = 0, 0, {}
    while num_kills < 10:
        root = tmp_path / f"{recording}"
        process = start(root, mode)
        wait_for_moment(process, root, references[mode], rng)
        if process.poll() is None:
            process.kill()  # not its workers
            process.wait()
            wait_for_end(marked_processes(str(root)))
            num_kills += 1
        if root.exists():
            assert contents(root) == references[mode].contents
        else:
            check_blocks(root, blocks)
        if process.returncode == 0:
            recording, blocks = recording + 1, {}
    root = tmp_path / f"{recording}"
    assert start(root, mode).wait(TIMEOUT_S) == 0
    assert contents(root) == references[mode].contents
    assert not list(tmp_path.glob("*.recording"))


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stopped_recorder_says_how_to_resume(
    number: int, code: int, references: dict[str, Reference], tmp_path: Path
) -> None:
    rng = random.Random(SEED)
    num_stops, recording, blocks = 0, 0, {}
    while num_stops < 4:
        root = tmp_path / f"{recording}"
        process = start(root, "video")
        deadline = time.monotonic() + TIMEOUT_S
        while not (unfinished_folder(root) / "lock").exists() and time.monotonic() < deadline:
            time.sleep(0.005)
        wait_for_moment(process, root, references["video"], rng)
        if process.poll() is None:
            os.killpg(process.pid, number)  # as a terminal does
            process.wait(TIMEOUT_S)
            wait_for_end(marked_processes(str(root)))
            num_stops += 1
        messages = root.with_suffix(".err").read_text()
        assert "Traceback" not in messages
        if root.exists():
            assert contents(root) == references["video"].contents
            recording, blocks = recording + 1, {}
        else:
            check_blocks(root, blocks)
            assert process.returncode == code
            assert ("continue with --resume" if blocks else "nothing is kept") in messages
            assert unfinished_folder(root).exists() == bool(blocks)
    root = tmp_path / f"{recording}"
    assert start(root, "video").wait(TIMEOUT_S) == 0
    assert contents(root) == references["video"].contents
