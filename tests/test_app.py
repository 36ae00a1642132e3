"""`lerobot-bomb app`: what a visitor chooses becomes a command, which a process runs and a page shows."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import pytest

from lerobot_bomb.bomb.perturbations import AXES
from lerobot_bomb.commands.app_page import SAME_CLEAN, app_page, choice_of, describe_run, run_both
from lerobot_bomb.commands.app_runs import Choice, Commands
from lerobot_bomb.commands.main import main

LEVELS = {"camera": 2, "light": 0, "start": 1}
ZEROS = [0] * len(AXES)


@pytest.fixture
def commands(tmp_path: Path) -> Iterator[Commands]:
    with Commands(tmp_path) as running:
        yield running


def num_frames(video: str) -> int:
    return int(cv2.VideoCapture(video).get(cv2.CAP_PROP_FRAME_COUNT))


@pytest.mark.parametrize(
    ("choice", "flags"),
    [
        (Choice("expert", "goal", 7), ["--policy=expert", "--env.task=goal", "--seed=7"]),
        (
            Choice("bomb:fdvla", "place", 0, "1", "4", "white", LEVELS),
            [
                "--policy.path=bomb:fdvla",
                "--env.task=place",
                "--seed=0",
                "--env.perturbations=camera:2+start:1",
                "--env.target=[1,4]",
                "--env.color=white",
            ],
        ),
        # a target that was chosen before the suite says nothing of another suite
        (
            Choice("me/policy", "long", 1, "1", "4"),
            ["--policy.path=me/policy", "--env.task=long", "--seed=1"],
        ),
    ],
)
def test_a_choice_is_a_command(choice: Choice, flags: list[str]) -> None:
    assert choice.flags() == flags


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        (Choice("bomb:nope", "place", 0), "no checkpoint 'nope'"),
        (Choice("nope", "place", 0), "nope is neither a folder nor a name on the Hub"),
        (Choice("", "place", 0), "1 to 300 characters"),
        (Choice("x" * 10_000, "place", 0), "1 to 300 characters"),
        (Choice(str(Path(__file__).parent), "place", 0), r"holds no config\.json"),
        (Choice("expert", "place", -1), "seed -1 must lie in"),
        (Choice("expert", "place", 2**32), "must lie in"),
        (Choice("expert", "place", 0, row="3"), "choose both row and column"),
    ],
)
def test_what_cannot_be_run_is_named(choice: Choice, message: str, commands: Commands) -> None:
    with pytest.raises(ValueError, match=message):
        commands.view(choice)


def test_a_fraction_is_no_seed() -> None:
    with pytest.raises(ValueError, match=r"seed 1\.5 must be a whole number"):
        choice_of("expert", "place", 1.5, "drawn", "drawn", "drawn", *ZEROS)


def test_both_episodes_are_those_of_view(
    commands: Commands, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    levels = [3 if axis == "camera" else 0 for axis in AXES]
    shown = run_both(commands, SAME_CLEAN, "expert", "place", 3, "drawn", "drawn", "drawn", *levels)
    videos, outcomes, lines = shown[::3], shown[1::3], shown[2::3]
    for video, outcome, line in zip(videos, outcomes, lines, strict=True):
        output = tmp_path / f"by_hand_{len(line)}"
        assert main([*line.split()[1:], f"--output={output}"]) == 0
        assert describe_run(capsys.readouterr().out) == outcome
        assert num_frames(video) == num_frames(f"{output}.mp4") > 10
    assert "camera:3" in lines[0] and "perturbations" not in lines[1]
    assert outcomes[0] != outcomes[1] or Path(videos[0]).read_bytes() != Path(videos[1]).read_bytes()
    with pytest.raises(ValueError, match="nothing to explain"):
        commands.explain(Choice("expert", "place", 3))
    # the simulator's process dies: one notice, and the next episode runs again
    for process in [*commands._pool._processes.values()]:
        os.kill(process.pid or 0, signal.SIGKILL)
    with pytest.raises(RuntimeError, match="the simulator's process ended"):
        commands.view(Choice("expert", "place", 3))
    assert commands.view(Choice("expert", "place", 3)).file.exists()
    with Commands(tmp_path) as again:  # in the folder of an earlier run
        assert again.view(Choice("expert", "place", 3)).file.exists()


def test_the_page_runs_and_says_what_is_wrong(commands: Commands) -> None:
    from gradio_client import Client

    blocks = app_page(commands, "expert")
    _, url, _ = blocks.launch(prevent_thread_lock=True, quiet=True, share=False)
    try:
        client = Client(url, verbose=False)
        values: list[Any] = ["expert", "place", 5, "drawn", "drawn", "drawn", *ZEROS]
        first, outcome, line, *_ = client.predict("expert", *values, api_name="/run")
        assert Path(first).stat().st_size > 1000 and "success after" in outcome
        assert line == "lerobot-bomb view --policy=expert --env.task=place --seed=5"
        with pytest.raises(Exception, match="no checkpoint"):
            client.predict("bomb:nope", *values, api_name="/run")
    finally:
        blocks.close()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--host=0.0.0.0"], "add --allow_network"),
        (["--port=0"], "--port=0 must lie in"),
        (["--policy.path=bomb:nope"], "no checkpoint 'nope'"),
        (["--policy.path=nope"], "neither a folder nor a name on the Hub"),
    ],
)
def test_wrong_flags_start_no_server(
    flags: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["app", *flags]) == 1
    assert message in capsys.readouterr().err
