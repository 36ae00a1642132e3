"""Writing of records to the file of `--env.results_path`. Simulator workers import this module."""

from pathlib import Path

from lerobot_bomb.files import append_line, check_appendable
from lerobot_bomb.results.record import Record


def check_results_path(path: str | None) -> None:
    """Raise a ValueError unless records can be appended to the file of `--env.results_path`."""
    if path is None:
        return
    try:
        check_appendable(Path(path))
    except OSError as error:
        raise ValueError(f"--env.results_path={path} cannot be written: {error}") from error


def write_record(path: Path | str, record: Record) -> None:
    """Append a record to the file of `--env.results_path`.

    Raises:
        OSError: it could not be written; the file still holds whole lines.
    """
    try:
        append_line(path, record.to_json())
    except OSError as error:
        raise OSError(
            error.errno,
            f"--env.results_path={path}: the result of seed {record.spec.seed} could not be written "
            f"({error.strerror}); the file holds those before it. Make room or name another file, and "
            "evaluate again: an episode that is run again counts once",
        ) from error
