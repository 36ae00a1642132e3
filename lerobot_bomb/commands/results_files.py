"""Files of results that a command is given."""

import sys
from pathlib import Path

from lerobot_bomb.envs.results import Row
from lerobot_bomb.evaluation.result_lines import check_any, read_lines

MAX_SHOWN_DAMAGES = 10


def read_undamaged(path: Path) -> tuple[list[Row], int]:
    """The episodes of a file, and how many damaged lines it has, of which stderr shows the first.

    Raises:
        ValueError: there is no such file, or no episode in it.
    """
    rows, damages = read_lines(path)
    for damage in damages[:MAX_SHOWN_DAMAGES]:
        print(f"{damage}; not counted", file=sys.stderr)
    if len(damages) > MAX_SHOWN_DAMAGES:
        print(f"{path}: ... and {len(damages) - MAX_SHOWN_DAMAGES} more such lines", file=sys.stderr)
    check_any(path, rows, damages)
    return rows, len(damages)
