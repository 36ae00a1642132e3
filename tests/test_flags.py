"""Flags as they are read, before anything heavy is imported."""

import argparse
from pathlib import Path

import pytest

from lerobot_bomb.commands.arguments import path_flag


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
