"""Appending to a file: whole lines or none, from several processes, on a full disk."""

import json
import resource
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from lerobot_bomb.files import append_line

LINE = json.dumps({"number": 1, "text": "x" * 200})


@contextmanager
def files_up_to(num_bytes: int) -> Iterator[None]:
    """The kernel writes no file beyond this size: a short write, then an error, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "lines.jsonl"


def test_a_line_that_does_not_fit_is_an_error_and_leaves_whole_lines(path: Path) -> None:
    append_line(path, LINE)
    whole = path.read_bytes()
    with files_up_to(len(whole) + 50), pytest.raises(OSError, match="File too large"):
        append_line(path, LINE)
    assert path.read_bytes() == whole
    append_line(path, LINE)
    assert path.read_bytes() == 2 * whole


def test_a_line_that_was_cut_off_does_not_take_the_next_one_along(path: Path) -> None:
    path.write_text(LINE[:50])
    append_line(path, LINE)
    append_line(path, LINE)
    assert path.read_text() == f"{LINE[:50]}\n{LINE}\n{LINE}\n"


def test_a_full_device_is_an_error() -> None:
    with pytest.raises(OSError, match="No space left on device"):
        append_line("/dev/full", LINE)


def test_lines_of_several_processes_do_not_mix(path: Path) -> None:
    path.write_text(LINE[:50])
    code = "import sys; from lerobot_bomb.files import append_line\n"
    code += "for _ in range(100): append_line(sys.argv[1], sys.argv[2])"
    processes = [subprocess.Popen([sys.executable, "-c", code, path, LINE * 30]) for _ in range(3)]
    assert [process.wait() for process in processes] == [0, 0, 0]
    assert path.read_text().splitlines() == [LINE[:50]] + 300 * [LINE * 30]
