"""Flags and folders of `lerobot-bomb record`: what is refused, before long work, and how."""

from pathlib import Path

import pytest
from filelock import FileLock

from lerobot_bomb import cli
from lerobot_bomb.data.record import record
from lerobot_bomb.data.recording import (
    METADATA_FILE,
    PARAMETERS_FILE,
    Recording,
    unfinished_folder,
    write_json,
)

FLAGS = ["record", "--repo_id=test/x", "--episodes=1"]


@pytest.mark.parametrize(
    ("flag", "allowed"),
    [
        ("--episodes=0", "at least 1"),
        ("--episodes=-3", "at least 1"),
        ("--workers=0", "at least 1"),
        ("--repo_id=nobody", "USER/NAME"),
        ("--task=chess", "place"),
        ("--robot=ur5", "scara"),
        ("--control_mode=joint", "relative, absolute"),
        ("--split=test", "all, train, heldout"),
        ("--noise=-0.1", "0..1"),
        ("--noise=2.0", "0..1"),
        ("--noise=nan", "0..1"),
        ("--fps=7", "1, 2, 4, 5, 8, 10, 20, 25, 40, 50, 100, 200"),
        ("--fps=0", "1, 2, 4"),
        ("--image_size=-256", "32..1024"),
        ("--image_size=100000", "32..1024"),
        ("--seed=-1", "must not be negative"),
    ],
)
def test_a_bad_flag_is_named_with_what_is_allowed(
    flag: str, allowed: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([*FLAGS, f"--root={tmp_path / 'x'}", flag]) == 1
    name, value = flag.split("=")
    message = capsys.readouterr().err
    assert f" {name}=" in message
    assert value in message
    assert allowed in message
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "x").mkdir()
    assert cli.main([*FLAGS, f"--root={tmp_path / 'x'}"]) == 1
    assert f"--root={tmp_path / 'x'} exists already" in capsys.readouterr().err
    assert cli.main([*FLAGS, f"--root={tmp_path / 'x'}", "--resume"]) == 1
    assert "holds no meta/bomb.json" in capsys.readouterr().err


def test_an_unfinished_recording_needs_resume(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    unfinished_folder(tmp_path / "x").mkdir()
    assert cli.main([*FLAGS, f"--root={tmp_path / 'x'}"]) == 1
    assert "go on with --resume or delete it" in capsys.readouterr().err


def test_there_must_be_something_to_resume(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*FLAGS, f"--root={tmp_path / 'x'}", "--resume=true"]) == 1
    message = capsys.readouterr().err
    assert f"--resume: there is no recording to go on with in --root={tmp_path / 'x'}" in message


@pytest.mark.parametrize("is_complete", [True, False])
def test_resume_refuses_other_parameters(
    is_complete: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "x"
    path = root / METADATA_FILE if is_complete else unfinished_folder(root) / PARAMETERS_FILE
    path.parent.mkdir(parents=True)
    write_json(path, {"recording": Recording("test/x", episodes=1, seed=3).to_dict()})
    assert cli.main([*FLAGS, f"--root={root}", "--seed=3", "--noise=0.1", "--resume"]) == 1
    message = capsys.readouterr().err
    assert "differs in --noise=0.1 (it has 0.0)" in message
    assert "--seed" not in message


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("not a folder")
    root = tmp_path / "file" / "x"
    assert cli.main([*FLAGS, f"--root={root}"]) == 1
    assert f"--root={root} cannot be written" in capsys.readouterr().err


def test_a_second_recorder_is_refused(tmp_path: Path) -> None:
    recording = Recording("test/x", episodes=1)
    folder = unfinished_folder(tmp_path / "x")
    folder.mkdir()
    with FileLock(folder / "lock"), pytest.raises(ValueError, match="another process is recording there"):
        record(recording, tmp_path / "x", resume=True)


def test_a_switch_takes_true_or_false(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main([*FLAGS, "--images=maybe"])
    assert "--images: 'maybe' must be true or false" in capsys.readouterr().err


def test_an_unknown_task_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*FLAGS, f"--root={tmp_path / 'x'}", "--task_ids=[0,50]"]) == 1
    assert "--task_ids has 50; 'place' has tasks 0..49" in capsys.readouterr().err


def test_task_ids_are_a_list_of_numbers(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main([*FLAGS, "--task_ids=[one]"])
    assert "--task_ids: '[one]' must be a list of whole numbers, as [0,7]" in capsys.readouterr().err


def test_a_task_outside_the_split_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*FLAGS, f"--root={tmp_path / 'x'}", "--task_ids=0,3", "--split=train"]) == 1
    assert "--target=[0, 3] is not in --split=train" in capsys.readouterr().err


def test_lerobots_folder_is_the_default(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lerobot.utils.constants.HF_LEROBOT_HOME", tmp_path)
    assert cli.main(["record", "--repo_id=test/home", "--episodes=1", "--image_size=64"]) == 0
    assert (tmp_path / "test" / "home" / "meta" / "info.json").exists()
