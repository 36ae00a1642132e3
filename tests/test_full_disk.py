"""A full disk is reported with the way out, wherever it is met, and nothing is dropped silently."""

import errno
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from result_rows import values

from lerobot_bomb import files
from lerobot_bomb.commands.main import main
from lerobot_bomb.results.groups import read_results
from lerobot_bomb.sweep.manifest import Manifest, plan
from lerobot_bomb.sweep.store import Store

FLAGS = ("--env.type=bomb", "--env.image_size=32", "--policy.device=cpu")
FULL = "No space left on device"
WAY_OUT = f"could not be written ({FULL}); what was there before stays. Make room"
SEEDS = [7, 8]
type Plant = Callable[[str], None]


@pytest.fixture
def full_for(monkeypatch: pytest.MonkeyPatch) -> Plant:
    """Let a whole file whose name ends so find no room, after a part of it."""

    def plant(ending: str) -> None:
        for name in ("write_text", "write_bytes"):
            usual: Any = getattr(Path, name)

            def write(self: Path, data: Any, usual: Any = usual) -> int:
                if not self.name.endswith(ending):
                    return usual(self, data)
                usual(self, data[: len(data) // 2])
                raise OSError(errno.ENOSPC, FULL, str(self))

            monkeypatch.setattr(Path, name, write)

    return plant


@pytest.fixture
def manifest() -> Manifest:
    return plan(("bomb_expert",), (), ("none",), SEEDS[0], num_episodes=2, batch_size=2, flags=FLAGS)


@pytest.fixture
def run_all(tmp_path: Path, manifest: Manifest) -> Callable[[], Store]:
    """Run it in this process."""
    from lerobot_bomb.sweep.worker import Worker

    def run_all() -> Store:
        store = Store(tmp_path / "sweep", manifest)
        Worker(store).run(list(manifest.jobs))
        return store

    return run_all


def check_whole(run_all: Callable[[], Store]) -> None:
    """Check that nothing is missing once there is room and the episodes have run again."""
    store = run_all()
    store.merge()
    assert [row.spec.seed for row in read_results(store.folder / "results.jsonl")] == SEEDS


def test_a_line_that_finds_no_room_gives_the_job_up_and_says_so(
    run_all: Callable[[], Store], manifest: Manifest, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_all = files._write_all

    def full(file: int, data: bytes) -> None:
        if b'"spec"' in data:
            write_all(file, data[:10])
            raise OSError(errno.ENOSPC, FULL)
        write_all(file, data)

    monkeypatch.setattr(files, "_write_all", full)
    store = run_all()
    text = "\n".join(store.lines())
    assert "0 of 2 episodes, 0 of 1 jobs" in text
    assert f"the result of seed 7 could not be written ({FULL})" in text and "Make room" in text
    assert f"to run them again: lerobot-bomb sweep {store.folder} --retry" in text
    monkeypatch.undo()
    store.begin_again(manifest.jobs)
    check_whole(run_all)


def test_a_job_whose_file_finds_no_room_is_given_up_and_says_so(
    run_all: Callable[[], Store], full_for: Plant, manifest: Manifest, monkeypatch: pytest.MonkeyPatch
) -> None:
    full_for(".jsonl")
    store = run_all()
    text = "\n".join(store.lines())
    assert f"{store.file(manifest.jobs[0], 'jsonl')} {WAY_OUT}" in text
    assert not list(store.folder.rglob(".unfinished-*"))
    monkeypatch.undo()
    store.begin_again(manifest.jobs)
    check_whole(run_all)


def test_results_that_find_no_room_stay_in_the_jobs(
    run_all: Callable[[], Store], full_for: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = run_all()
    store.merge()
    before = (store.folder / "results.jsonl").read_text()
    full_for("results.jsonl")
    with pytest.raises(OSError, match=FULL) as raised:
        store.merge()
    assert f"{store.folder / 'results.jsonl'} {WAY_OUT}" in str(raised.value)
    assert (store.folder / "results.jsonl").read_text() == before
    monkeypatch.undo()
    check_whole(run_all)


def test_a_manifest_that_finds_no_room_is_told(
    tmp_path: Path, full_for: Plant, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["sweep", str(tmp_path), "--policies=bomb_expert", "--dry_run", *FLAGS]
    full_for("manifest.json")
    assert main(command) == 1
    assert f"{tmp_path / 'manifest.json'} {WAY_OUT}" in capsys.readouterr().err
    # a lock is never removed: another sweep may hold it
    assert [path.name for path in tmp_path.iterdir()] == ["sweep.lock"]
    monkeypatch.undo()
    assert main(command) == 0
    assert len(Manifest.read(tmp_path).jobs) == 1


@pytest.mark.parametrize("ending", [".html", ".json", ".csv"])
def test_a_page_that_finds_no_room_is_told_and_the_one_before_stays(
    ending: str, tmp_path: Path, full_for: Plant, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = tmp_path / "lines.jsonl"
    lines.write_text(json.dumps(values(0)) + "\n")
    command = ["report", str(lines), f"--output={tmp_path / 'r.html'}"]
    assert main(command) == 0
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    full_for(ending)
    assert main(command) == 1
    message = capsys.readouterr().err
    assert message.startswith(f"lerobot-bomb report: [Errno {errno.ENOSPC}] {tmp_path / 'r.html'}, ")
    assert WAY_OUT in message and message.count("\n") == 1
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
