"""Commands and flags as they are read, before anything heavy is imported."""

import argparse
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from lerobot_bomb.commands.arguments import long_forms, path_flag
from lerobot_bomb.commands.main import command_parser, main
from lerobot_bomb.commands.table import COMMANDS, RENAMED, overview

GROUPS = {
    "Datasets and episodes": ["record", "convert", "view"],
    "Results": ["results", "compare", "report", "export"],
    "Evaluate and diagnose": ["sweep", "replay", "audit", "explain", "app"],
    "Checkpoints": ["checkpoint", "push", "serve"],
    "Installation": ["config", "demo", "doctor"],
}
# in a folder without any of these
WRONG = [
    "view --policy.path=absent",
    "view --env.type=nothing",
    "explain --policy.path=absent",
    "explain --policy.path=bomb:fdvla --line=2",
    "sweep new --policies=absent/x/y --env.type=bomb",
    "sweep new --policies=no_such_type --env.type=bomb",
    "sweep new --policies=bomb:fdvla --env.type=nothing",
    "results absent.jsonl",
    "results add absent.jsonl --env.type=pusht",
    "results smoothness --dataset.repo_id=x --fps=0",
    "results actions /absent/x.jsonl",
    "compare absent.jsonl",
    "report absent.jsonl",
    "export absent.jsonl",
    "serve --socket=absent/socket",
    "serve --port=0",
    "push absent --repo_id=me/x",
    "push . --repo_id=me/x",
    "replay absent.jsonl",
    "audit new --policy.path=absent",
    "record --repo_id=me/x --episodes=1 --robot=nothing",
    "checkpoint path nothing",
    "checkpoint merge --policy.path=absent --output=new",
    "checkpoint export-backbone --policy.path=absent --output=new",
    "checkpoint offline-metrics --policy.path=absent --dataset.repo_id=x",
    "checkpoint convert-spatialvla absent --output=new",
    "checkpoint init --policy.type=act --dataset.repo_id=x --output=.",
    "checkpoint fit-grid --dataset.repo_id=x --plot=absent/x.png",
]
PROGRAM = """
import shlex, sys
from lerobot_bomb.commands.main import main
for command in sys.stdin.read().splitlines():
    code, heavy = main(shlex.split(command)), {"torch", "lerobot", "transformers"} & sys.modules.keys()
    if code != 1 or heavy:
        sys.exit(f"{command}: exit code {code}, imported {heavy}")
"""


def test_the_overview_lists_the_commands_in_five_groups() -> None:
    found: dict[str, list[str]] = {}
    for line in overview().splitlines():
        if line.endswith(":") and not line.startswith(" "):
            found[line[:-1]] = words = []
        elif line.startswith("  ") and line[2] != " ":
            words.append(line.split()[0])
    assert found == GROUPS
    second = [name.partition(" ")[2] for name in COMMANDS if " " in name]
    assert all(f" {word}" in overview() for word in second)


@pytest.mark.parametrize("old", RENAMED)
def test_an_old_command_is_answered_with_the_new_one(old: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([old, "--flag=x"]) == 2
    told = f"lerobot-bomb: `lerobot-bomb {old}` is now `lerobot-bomb {RENAMED[old]}`\n"
    assert capsys.readouterr().err == told
    assert RENAMED[old] in COMMANDS or RENAMED[old] == "--completion"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("recrod", "'recrod' is no command; nearest: record; `lerobot-bomb --help` lists all"),
        (
            "checkpoint mrege",
            "'checkpoint mrege' is no command; nearest: checkpoint merge; there are path, init",
        ),
        ("checkpoint bomb:fdvla", "'checkpoint bomb:fdvla' is no command; "),
        ("xyzzy", "'xyzzy' is no command; `lerobot-bomb --help` lists all"),
    ],
)
def test_a_word_that_is_no_command_names_the_nearest(
    words: str, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words.split()) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"lerobot-bomb: {told}") and error.count("\n") == 1


def test_a_family_lists_its_commands(capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["convert"], ["convert", "--help"]):
        assert main(words) == 0
        shown = capsys.readouterr().out
        assert "lerobot-bomb convert pusht-zarr" in shown and "lerobot-bomb convert libero-hdf5" in shown


@pytest.mark.parametrize("name", COMMANDS)
def test_help_begins_with_two_examples_that_are_read(name: str) -> None:
    parser = command_parser(name)
    examples = parser.format_help().splitlines()[:2]
    assert all(example.startswith(f"  lerobot-bomb {name}") for example in examples)
    for example in COMMANDS[name].examples:
        if " ".join([*name.split(), *example.split()[:1]]) not in COMMANDS:
            args, unknown = parser.parse_known_args(shlex.split(example))
            assert not unknown or "rest" in args, unknown


def test_a_flag_of_the_environment_has_a_long_and_a_short_form() -> None:
    parser = command_parser("view")
    short = [
        "--task=goal",
        "--robot=fetch",
        "--image_size=96",
        "--perturbations=camera:3",
        "--depth",
        "--target=[1,2]",
    ]
    long = [f"--env.{flag.removeprefix('--')}" for flag in short]
    assert parser.parse_args(short) == parser.parse_args(long) != parser.parse_args([])
    assert long_forms([*short[:3], "--seed=3"]) == [*long[:3], "--seed=3"]


def test_what_is_wrong_is_told_before_torch_and_lerobot_are_imported(tmp_path: Path) -> None:
    ran = subprocess.run(
        [sys.executable, "-c", PROGRAM], input="\n".join(WRONG), text=True, cwd=tmp_path, capture_output=True
    )
    assert ran.returncode == 0, ran.stderr
    assert len(ran.stderr.splitlines()) == len(WRONG), ran.stderr
    assert not [*tmp_path.rglob("*.*")]


def test_a_path_may_start_in_the_home_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/me")
    assert path_flag("~/x") == Path("/home/me/x")
    assert path_flag("x/~") == Path("x/~")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "a path must not be empty"),
        ("\udcff", "is not UTF-8"),
        ("~nobody-of-this-name/x", "this user has no home folder here"),
    ],
)
def test_what_is_no_path_is_said(text: str, message: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match=message):
        path_flag(text)
