"""Errors in flags, worded so that LeRobot's commands print them as one line."""

import re
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from typing import Any, NoReturn

from draccus.utils import DecodingError


class FlagError(DecodingError):
    """A config's flag has a value that is not allowed.

    LeRobot's commands print it in one line, whether the value came from a flag or a file. If a config raises
    a ValueError, their parser drops its text.
    """

    def __init__(self, message: str) -> None:
        super().__init__((), message)

    def strip_prefix(self, prefix: Sequence[str]) -> NoReturn:
        """Raise this error itself, where draccus would list what is wrong for every type of a union."""
        raise self


def hint(words: Sequence[str], flags: Collection[str], argv: Sequence[str]) -> str:
    """Return the end of an error message: flags that are spelled much like these words, and how to list all.

    Args:
        words: the wrong ones, such as --env.tsak=place.
        flags: all that exist.
        argv: the command's words. Types among them go before --help, which then lists their flags.
    """
    types = [word for word in argv if re.match(r"--\w+\.type=", word)]
    return f"{nearest(words, flags)}; {' '.join([*types, '--help'])} lists all flags"


def nearest(words: Sequence[str], flags: Collection[str]) -> str:
    """Return '; nearest: --seed' with the flags that are spelled much like these words; '' if none is."""
    near = [flag for word in words if word.startswith("--") for flag in nearest_flags(word, flags)]
    return f"; nearest: {', '.join(near)}" * bool(near)


def nearest_flags(word: str, flags: Collection[str]) -> list[str]:
    """Return the flags spelled much like `--GROUP.NAME=VALUE`, from its group where that exists."""
    flag = word.partition("=")[0]
    group = flag.rpartition(".")[0]
    names = {_name(other): other for other in flags if other.rpartition(".")[0] == group}
    if not names:
        return get_close_matches(flag, flags, n=1)
    return [names[near] for near in get_close_matches(_name(flag), names)]


def _name(flag: str) -> str:
    return flag.rpartition(".")[2].lstrip("-")


def refuse_unknown(flag: str, flags: Collection[str], argv: Sequence[str]) -> NoReturn:
    """Raise a FlagError that says that the chosen type has no such flag."""
    raise FlagError(f"{flag} is no flag of this type{hint([flag], flags, argv)}")


@contextmanager
def flag_errors() -> Iterator[None]:
    """Raise the ValueErrors of a config's checks as FlagError."""
    try:
        yield
    except ValueError as error:
        raise FlagError(str(error)) from None


def check_eval_flags(config: Any) -> None:
    """Raise a FlagError if LeRobot's EvalPipelineConfig runs no episode, or records several."""
    if config.eval.n_episodes < 1:
        raise FlagError(f"--eval.n_episodes={config.eval.n_episodes} must be at least 1")
    if config.eval.recording and config.eval.n_episodes > 1:
        raise FlagError(
            f"--eval.recording=true with --eval.n_episodes={config.eval.n_episodes}: LeRobot writes one "
            "instruction for all episodes of a batch, and cannot record a second batch. Give "
            "--eval.n_episodes=1, and --seed=NUMBER for other episodes; each task of --env.task_ids and "
            "condition of --env.perturbations is recorded"
        )
