"""Flags and folders of `lerobot-bomb record`: what is refused, before long work, and how."""

import argparse
import ctypes
import importlib
import os
import signal
import subprocess
import sys
import time
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
from lerobot.envs import EnvConfig

from lerobot_bomb.commands import main as cli
from lerobot_bomb.commands.arguments import LONG_FORMS, parse_conditions
from lerobot_bomb.conditions import NONE
from lerobot_bomb.data.kept_blocks import Progress, finish_block, write_json
from lerobot_bomb.data.recording import Recording
from lerobot_bomb.data.resumable import terminated_in_order
from lerobot_bomb.data.unfinished import (
    METADATA_FILE,
    check_folders,
    lock_folder,
    parameters_file,
    unfinished_folder,
)
from lerobot_env_bomb.bomb.configuration_bomb import BombEnvConfig

FLAGS = ["record", "--repo_id=test/x", "--episodes=1"]
RECORDING = Recording("test/x", episodes=1)
# of Linux
PR_CAPBSET_DROP = 24
CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH = 1, 2


@pytest.mark.parametrize(
    ("flag", "allowed"),
    [
        ("--episodes=0", "at least 1"),
        ("--episodes=-3", "at least 1"),
        ("--workers=0", "must lie in 1.."),
        ("--workers=1000000000", "must lie in 1.."),
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
        ("--perturbations=camera:9", "0..5"),
        ("--perturbations=[]", "none"),
        ("--perturbations=haze:1", "table, reflectance, stones"),
        ("--perturbations=camera:1,camera:1-1", "a condition twice"),
        ("--target=[1,5]", "[row, column], each in 0..4"),
        ("--target=[1]", "[row, column], each in 0..4"),
        ("--color=green", "black, white"),
        ("--render_preset=bright", "fast, shadows"),
        ("--success_tolerance_mm=30.0", "between 0 and half the pitch"),
        ("--seed=-1", "0..4294967295"),
        ("--seed=99999999999999999999", "0..4294967295"),
    ],
)
def test_a_bad_flag_is_named_with_what_is_allowed(
    flag: str, allowed: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([*FLAGS, f"--root={tmp_path / 'x'}", flag]) == 1
    name, value = flag.split("=")
    message = capsys.readouterr().err
    assert f" {LONG_FORMS.get(name, name)}=" in message
    assert value in message.replace(", ", ",")
    assert allowed in message
    assert message.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "x").mkdir()
    assert cli.main([*FLAGS, f"--root={tmp_path / 'x'}"]) == 1
    message = capsys.readouterr().err
    assert f"--root={tmp_path / 'x'} exists already; name a folder that does not exist yet" in message
    assert "delete" not in message
    assert cli.main([*FLAGS, f"--root={tmp_path / 'x'}", "--resume"]) == 1
    assert "holds no meta/bomb.json" in capsys.readouterr().err


def test_a_finished_recording_is_told_from_other_folders(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "x" / METADATA_FILE
    path.parent.mkdir(parents=True)
    write_json(path, {"recording": RECORDING.to_dict()})
    assert cli.main([*FLAGS, f"--root={tmp_path / 'x'}"]) == 1
    message = capsys.readouterr().err
    assert "exists already, a finished recording: --resume checks that it is this one" in message


def test_an_unfinished_recording_needs_resume(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = unfinished_folder(tmp_path / "x")
    folder.mkdir()
    write_json(parameters_file(folder), {"recording": RECORDING.to_dict()})
    assert cli.main([*FLAGS, f"--root={tmp_path / 'x'}"]) == 1
    assert "continue with --resume or delete it" in capsys.readouterr().err


def test_a_folder_of_something_else_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = unfinished_folder(tmp_path / "x")
    folder.mkdir()
    (folder / "mine").touch()
    assert cli.main([*FLAGS, f"--root={tmp_path / 'x'}"]) == 1
    message = capsys.readouterr().err
    assert "so it is no recording" in message and "delete" not in message
    assert cli.main([*FLAGS, f"--root={tmp_path / 'x'}", "--resume"]) == 1
    assert f"--resume: {folder} holds no recording.json, so it is no recording" in capsys.readouterr().err
    assert (folder / "mine").exists()


def test_there_must_be_something_to_resume(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*FLAGS, f"--root={tmp_path / 'x'}", "--resume=true"]) == 1
    message = capsys.readouterr().err
    assert f"--resume: there is no recording to resume in --root={tmp_path / 'x'}" in message


@pytest.mark.parametrize("is_complete", [True, False])
def test_resume_refuses_other_parameters(
    is_complete: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "x"
    path = root / METADATA_FILE if is_complete else parameters_file(unfinished_folder(root))
    path.parent.mkdir(parents=True)
    write_json(path, {"recording": Recording("test/x", episodes=1, seed=3).to_dict()})
    assert cli.main([*FLAGS, f"--root={root}", "--seed=3", "--noise=0.1", "--resume"]) == 1
    message = capsys.readouterr().err
    assert "differs in noise=0.1 (it has 0.0)" in message
    assert "--seed" not in message


def record_without_privileges(root: Path, *flags: str) -> str:
    """Record as one whom permissions bind; return what it says on stderr. LeRobot must not be imported."""
    script = (
        "import sys; from lerobot_bomb.commands.main import main; code = main(sys.argv[1:])\n"
        "assert not {'torch', 'lerobot', 'mujoco'} & set(sys.modules); sys.exit(code)"
    )
    command = [sys.executable, "-c", script, *FLAGS, f"--root={root}", *flags]
    run = subprocess.run(command, preexec_fn=be_bound_by_permissions, capture_output=True, text=True)
    assert run.returncode == 1, run.stderr
    return run.stderr


def be_bound_by_permissions() -> None:
    """Give up what lets root write anywhere, from the next exec on."""
    libc = ctypes.CDLL(None, use_errno=True)
    for capability in (CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH):
        if os.geteuid() == 0 and libc.prctl(PR_CAPBSET_DROP, capability, 0, 0, 0):
            raise OSError(ctypes.get_errno(), "prctl")


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("not a folder")
    root = tmp_path / "file" / "x"
    assert cli.main([*FLAGS, f"--root={root}"]) == 1
    assert f"--root={root} cannot be written" in capsys.readouterr().err


def test_a_folder_without_write_permission_is_named(tmp_path: Path) -> None:
    tmp_path.chmod(0o555)
    root = tmp_path / "x"
    message = record_without_privileges(root)
    assert message.startswith(f"lerobot-bomb record: --root={root} cannot be written: [Errno 13] Permission")
    assert message.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("read_only", [".", "x.recording", "x.recording/lock"])
def test_an_unfinished_recording_without_write_permission_is_kept(read_only: str, tmp_path: Path) -> None:
    root = tmp_path / "x"
    unfinished = tmp_path / "x.recording" / "block-00000.tmp"
    unfinished.mkdir(parents=True)
    (tmp_path / "x.recording" / "lock").touch()
    write_json(parameters_file(tmp_path / "x.recording"), {"recording": RECORDING.to_dict()})
    finish_block(unfinished, unfinished.with_suffix(""), Progress(1, 20))
    before = sorted(tmp_path.rglob("*"))
    (tmp_path / read_only).chmod(0o555 if (tmp_path / read_only).is_dir() else 0o444)
    message = record_without_privileges(root, "--resume")
    assert message.startswith(f"lerobot-bomb record: --root={root}")
    assert "[Errno 13] Permission denied" in message
    assert message.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_a_read_only_file_system_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["mount", "-t", "tmpfs", "-o", "ro", "none", str(tmp_path)]
    mounted = subprocess.run(command, capture_output=True, text=True)
    if mounted.returncode:
        pytest.skip(f"no file system can be mounted ({mounted.stderr.strip()}); try `unshare -rm`")
    try:
        assert cli.main([*FLAGS, f"--root={tmp_path / 'x'}"]) == 1
        message = f"--root={tmp_path / 'x'} cannot be written: [Errno 30] Read-only file system"
        assert message in capsys.readouterr().err
    finally:
        subprocess.run(["umount", str(tmp_path)], check=True)


def test_a_second_recorder_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with lock_folder(unfinished_folder(tmp_path / "x")):
        for resume in (False, True):
            assert cli.main([*FLAGS, f"--root={tmp_path / 'x'}", f"--resume={resume}"]) == 1
            assert f"another process is at work in {tmp_path / 'x.recording'}" in capsys.readouterr().err


def test_ctrl_c_while_a_command_is_imported_is_no_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(name: str) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli.importlib, "import_module", interrupted)
    assert cli.main(FLAGS) == 130
    assert capsys.readouterr().err == "lerobot-bomb record: interrupted\n"


@pytest.mark.parametrize(
    ("number", "error"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit)]
)
def test_a_signal_that_a_destructor_swallows_is_not_lost(number: int, error: type[BaseException]) -> None:
    class Destroyed:
        def __del__(self) -> None:
            signal.raise_signal(number)

    usual = signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
    try:
        with terminated_in_order(), pytest.raises(error):
            Destroyed()
            time.sleep(10)
            pytest.fail("it went on")
    finally:
        signal.signal(signal.SIGINT, usual)


def test_a_switch_takes_true_or_false(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main([*FLAGS, "--images=maybe"])
    assert "--images: 'maybe' must be true or false" in capsys.readouterr().err


def test_an_unknown_task_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*FLAGS, f"--root={tmp_path / 'x'}", "--task_ids=[0,50]"]) == 1
    assert "--env.task_ids has 50; 'place' has tasks 0..49" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["[one]", "[1", "[[0,1]]", "[]", "1,", "-1"])
def test_task_ids_are_a_list_of_numbers(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main([*FLAGS, f"--task_ids={text}"])
    assert f"--task_ids: {text!r} must be a list of whole numbers, as [0,7]" in capsys.readouterr().err


def test_a_task_is_given_once(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*FLAGS, "--task_ids=[1,7,1]"]) == 1
    assert "--env.task_ids=[1, 7, 1] has a task twice" in capsys.readouterr().err


def test_a_task_outside_the_split_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*FLAGS, f"--root={tmp_path / 'x'}", "--task_ids=0,3", "--split=train"]) == 1
    assert "the target [0, 3] is not in --env.split=train" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("flag", ["--target=[1,2]", "--color=white"])
def test_numbered_tasks_and_a_target_exclude_each_other(
    flag: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in ([*FLAGS, f"--root={tmp_path / 'x'}"], ["view", f"--output={tmp_path / 'x'}"]):
        assert cli.main([*command, "--task_ids=[7]", flag]) == 1
        error = capsys.readouterr().err
        assert error.startswith(f"lerobot-bomb {command[0]}: --env.task_ids fixes targets and colours; drop")
        assert error.endswith("drop --env.target and --env.color\n")
    assert list(tmp_path.iterdir()) == []


def test_a_target_outside_the_split_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*FLAGS, f"--root={tmp_path / 'x'}", "--target=[0,3]", "--split=train"]) == 1
    assert "--env.target=[0, 3] is not in --env.split=train" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["record", "view"])
def test_an_episode_has_the_flags_of_the_environment(command: str) -> None:
    """Check both commands against --env.type=bomb: one set of names, with the same defaults."""
    parser = argparse.ArgumentParser()
    module = importlib.import_module(f"lerobot_bomb.commands.{command}")
    module.add_arguments(parser)
    ours = {action.dest: action.default for action in parser._actions}
    flags = {action.dest: action.option_strings for action in parser._actions}
    env = BombEnvConfig()
    of_lerobot = {field.name for field in fields(EnvConfig)} - {"task", "fps"}
    names = {field.name for field in fields(env)} - of_lerobot - {"results_path", "ignore_checkpoint"}
    assert names <= ours.keys()
    assert names <= {field.name for field in fields(Recording)}
    several: dict[str, Any] = {"task_ids": (), "perturbations": (NONE,)}  # None: one episode
    if command == "record":  # of several environments, each with its own default
        several["render_preset"] = None
    assert all({f"--env.{name}", f"--{name}"} <= {*flags[name]} for name in names)
    assert {name: ours[name] for name in names} == {name: getattr(env, name) for name in names} | several


def test_a_recording_of_before_the_target_had_a_flag_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = parameters_file(unfinished_folder(tmp_path / "x"))
    path.parent.mkdir()
    before = RECORDING.to_dict()
    for name in ("target", "color", "render_preset", "success_tolerance_mm"):
        del before[name]
    write_json(path, {"recording": before})
    check_folders(RECORDING, tmp_path / "x", path.parent, resume=True)
    assert cli.main([*FLAGS, f"--root={tmp_path / 'x'}", "--resume", "--target=[1,2]"]) == 1
    assert "differs in target=[1, 2] (it has None)" in capsys.readouterr().err
    del before["mujoco_version"]  # not known, so perhaps another
    write_json(path, {"recording": before})
    with pytest.raises(ValueError, match=r"differs in mujoco_version='.*' \(it has None\)"):
        check_folders(RECORDING, tmp_path / "x", path.parent, resume=True)


def test_lerobots_folder_is_the_default(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lerobot.utils.constants.HF_LEROBOT_HOME", tmp_path)
    assert cli.main(["record", "--repo_id=test/home", "--episodes=1", "--image_size=64"]) == 0
    assert (tmp_path / "test" / "home" / "meta" / "info.json").exists()


@pytest.mark.parametrize("text", ["none,all:1-5", '["none", "all:1-5"]', '[\n    "none",\n    "all:1-5"\n]'])
def test_conditions_are_read_from_a_list_on_one_line_or_several(text: str) -> None:
    assert parse_conditions(text) == ("none", "all:1-5")


@pytest.mark.parametrize(
    ("seed", "episodes", "is_warned"),
    [(0, 1000, False), (0, 1001, True), (999, 3, True), (1199, 1, True), (1200, 1, False), (500, 5000, True)],
)
def test_seeds_that_evaluations_play_are_pointed_out(
    seed: int, episodes: int, is_warned: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = ["record", "--repo_id=test/x", f"--episodes={episodes}", f"--seed={seed}", f"--root={tmp_path}"]
    assert cli.main(flags) == 1  # the folder exists
    last = seed + episodes - 1
    said = f"the seeds {seed}..{last} have episodes that evaluations run, 1000 to 1199"
    assert (said in capsys.readouterr().err) == is_warned
