"""Files of results that a command is given."""

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from lerobot_bomb.envs.results import Row
from lerobot_bomb.evaluation.result_lines import check_any, read_lines
from lerobot_bomb.sweep.store import ERRORS, RESULTS

MAX_SHOWN_DAMAGES = 10


def check_outputs(inputs: Sequence[Path], outputs: Iterable[Path]) -> None:
    """Raise a ValueError if one of the files that are written is one of those that are read."""
    read = {path.resolve() for path in inputs}
    for path in outputs:
        if path.resolve() in read:
            raise ValueError(f"--output: {path} is a file of results that is read; name another output")


def _tell_missing(path: Path) -> None:
    """Of a sweep's file: how many episodes have no line because an error ended them."""
    errors = path.with_name(ERRORS)
    if path.name == RESULTS and errors.is_file() and (number := errors.read_bytes().count(b"\n")):
        print(f"{path}: {number} episodes are missing, an error ended them: {errors}", file=sys.stderr)


def read_undamaged(path: Path) -> tuple[list[Row], int]:
    """The episodes of a file, and how many damaged lines it has, of which stderr shows the first.

    It also says there how many episodes of a sweep are missing.

    Raises:
        ValueError: there is no such file, or no episode in it.
    """
    rows, damages = read_lines(path)
    _tell_missing(path)
    for damage in damages[:MAX_SHOWN_DAMAGES]:
        print(f"{damage}; not counted", file=sys.stderr)
    if len(damages) > MAX_SHOWN_DAMAGES:
        print(f"{path}: ... and {len(damages) - MAX_SHOWN_DAMAGES} more such lines", file=sys.stderr)
    check_any(path, rows, damages)
    return rows, len(damages)
