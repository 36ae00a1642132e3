"""Checkpoints named `bomb:NAME`, and the first use of a type of ours: the one hook always installed."""

import re
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from inspect import signature
from itertools import pairwise
from pathlib import Path

from huggingface_hub.constants import CONFIG_NAME
from lerobot.configs import PreTrainedConfig, parser
from lerobot.envs import EnvConfig

from lerobot_bomb.compat.hooks.replace import replace
from lerobot_bomb.compat.use import is_ours, use


def resolve_checkpoints(prefix: str, resolve: Callable[[str], str]) -> None:
    """Let `resolve` change `--policy.path` of LeRobot's commands and config files.

    Only paths that start with `prefix` change. A ValueError of `resolve` ends the command in one line.

    LeRobot's commands ask for a path before they read any other flag. If flags name a type of ours, the
    other hooks are installed, so that wrong flags are reported, too.
    """

    def around(usual: Callable[..., str | None]) -> Callable[..., str | None]:
        def get_path_arg(*args, **kwargs) -> str | None:
            given = signature(usual).bind(*args, **kwargs).arguments
            if names_ours(given.get("args") or sys.argv[1:]):
                use()
            path = usual(*args, **kwargs)
            if path is None or not path.startswith(prefix):
                return path
            use()
            try:
                return resolve(path)
            except ValueError as error:
                sys.exit(f"--{given['field_name']}.path={path}: {error}")

        return get_path_arg

    replace(parser, "get_path_arg", around)


def names_ours(argv: Sequence[str]) -> bool:
    """Return True if flags, or the config file or checkpoint that they name, choose a type of ours."""
    known = {**EnvConfig.get_known_choices(), **PreTrainedConfig.get_known_choices()}
    return any(is_ours(known[name]) for name in _named_types(argv) if name in known)


def _named_types(argv: Sequence[str]) -> set[str]:
    words = [word for each in argv for word in each.split("=", 1)]
    named, files = set[str](), list[Path]()
    for flag, value in pairwise(words):
        if flag.startswith("--") and flag.endswith(".type"):
            named.add(value)
        elif flag.startswith("--") and flag.endswith("path"):
            files += [Path(value), Path(value) / CONFIG_NAME]
    for file in files:
        with suppress(OSError, ValueError):  # no text, or no path at all: whoever reads it will say so
            named.update(re.findall(r"""\btype["']?\s*:\s*["']?(\w+)""", file.read_text()))
    return named
