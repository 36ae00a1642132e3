"""Records for a report, and the report of them."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from result_rows import ACT, values

from lerobot_bomb.commands.main import main
from lerobot_bomb.results.origin import PolicyIdentity

type Rows = list[dict[str, Any]]


def write(path: Path, rows: Rows) -> Path:
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


def section_by_title(folder: Path, *files: Rows, flags: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return {title: section} of the report of rows, whose page is out/r.html in a folder."""
    paths = [str(write(folder / f"{number}.jsonl", rows)) for number, rows in enumerate(files)]
    assert main(["report", *paths, f"--output={folder / 'out' / 'r.html'}", *flags]) == 0
    return {each["title"]: each for each in json.loads((folder / "out" / "r.json").read_text())}


def columns(table: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the table's rows by the names of their columns."""
    return [dict(zip(table["header"], row, strict=True)) for row in table["rows"]]


def perturbed(failures: Mapping[str, Sequence[str | None]], policy: PolicyIdentity = ACT) -> Rows:
    """An episode for each seed from 0 on, under each condition."""
    return [
        values(seed, failure, policy=policy, spec={"perturbations": condition})
        for condition, outcomes in failures.items()
        for seed, failure in enumerate(outcomes)
    ]
