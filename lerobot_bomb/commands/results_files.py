"""Files of results that a command is given."""

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from lerobot_bomb.envs.results import Row
from lerobot_bomb.evaluation.result_lines import check_any, read_lines
from lerobot_bomb.sweep.manifest import NAME, Manifest
from lerobot_bomb.sweep.store import ERRORS, RESULTS

MAX_SHOWN_DAMAGES = 10


def check_outputs(inputs: Sequence[Path], outputs: Iterable[Path]) -> None:
    """Raise a ValueError if one of the files that are written is one of those that are read."""
    read = {path.resolve() for path in inputs}
    for path in outputs:
        if path.resolve() in read:
            raise ValueError(f"--output: {path} is a file of results that is read; name another output")


def missing_of_sweep(path: Path, num_rows: int) -> str:
    """Say how many episodes a sweep's file of so many rows lacks, and why; "": none, or it is no sweep's."""
    if path.name != RESULTS or not path.with_name(NAME).is_file():
        return ""
    number, errors = Manifest.read(path.parent).num_episodes, path.with_name(ERRORS)
    missing = number - num_rows
    num_errors = errors.read_bytes().count(b"\n") if errors.is_file() else 0
    reasons = [f"an error ended {num_errors}: {errors}"] if num_errors else []
    reasons += [f"`lerobot-bomb sweep {path.parent}` goes on"] if missing > num_errors else []
    return f"{path}: {missing} of {number} episodes are missing; {'; '.join(reasons)}" if missing > 0 else ""


def read_line(path: Path, line: int) -> Row:
    """Return a record by its line, counted from 1.

    Raises:
        ValueError: there is no such line, or as `read_undamaged`.
    """
    rows, _ = read_undamaged(path)
    if not 1 <= line <= len(rows):
        raise ValueError(f"--line={line} must be in 1..{len(rows)}, the episodes of {path}")
    return rows[line - 1]


def read_undamaged(path: Path) -> tuple[list[Row], int]:
    """Return a file's records, and the number of its damaged lines, of which stderr shows the first.

    It also says there how many episodes of a sweep are missing.

    Raises:
        ValueError: there is no such file, or no episode in it.
    """
    rows, damages = read_lines(path)
    for damage in damages[:MAX_SHOWN_DAMAGES]:
        print(f"{damage}; not counted", file=sys.stderr)
    if len(damages) > MAX_SHOWN_DAMAGES:
        print(f"{path}: ... and {len(damages) - MAX_SHOWN_DAMAGES} more such lines", file=sys.stderr)
    check_any(path, rows, damages)
    if missing := missing_of_sweep(path, len(rows)):
        print(missing, file=sys.stderr)
    return rows, len(damages)
