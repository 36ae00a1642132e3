"""Records of results files, of whichever environment: read and checked."""

import json
from collections.abc import Collection
from pathlib import Path
from typing import Any

from lerobot_bomb.envs.results import Row
from lerobot_bomb.evaluation.bomb_lines import BOMB_LINES
from lerobot_bomb.evaluation.libero_lines import LIBERO_LINES
from lerobot_bomb.evaluation.line_checks import (
    Check,
    check_fields,
    check_text,
    is_bool,
    is_int,
    is_sha256,
    is_text,
    or_none,
)
from lerobot_bomb.evaluation.pusht_lines import PUSHT_LINES
from lerobot_bomb.evaluation.result_kind import ResultKind
from lerobot_bomb.evaluation.stock_lines import STOCK_LIBERO_LINES, STOCK_PUSHT_LINES

KINDS = (BOMB_LINES, PUSHT_LINES, LIBERO_LINES, STOCK_PUSHT_LINES, STOCK_LIBERO_LINES)
KIND_OF_ENV = {kind.env_type: kind for kind in KINDS}
KIND_OF_VERSION = {version: kind for kind in KINDS for version in kind.fields}

POLICY_CHECKS: dict[str, Check] = {
    "type": is_text,
    "path": or_none(is_text),
    "revision": or_none(is_text),
    "weights_sha256": or_none(is_sha256),
    "settings_sha256": or_none(is_sha256),
    "base": or_none(is_text),
    "is_in_training": is_bool,
}
# what lines of earlier releases do not have
ADDED_POLICY_CHECKS: dict[str, Check] = {
    "batch_size": or_none(is_int(1)),
    "batch_row": or_none(is_int(0)),
    "interventions": lambda value: isinstance(value, list) and all(map(is_text, value)),
}


def _check_batch(policy: dict[str, Any]) -> None:
    number, size = policy.get("batch_row"), policy.get("batch_size")
    if number is not None and size is not None and number >= size:
        raise ValueError(f"policy.batch_row={number} is impossible with policy.batch_size={size}")


def read_lines(path: Path) -> tuple[dict[int, Row], list[str]]:
    """Return {line number, from 1: episode} of a results file, and what is wrong with its other lines.

    Raises:
        ValueError: there is no such file.
    """
    if path.is_dir():
        files = ", ".join(str(each) for each in sorted(path.glob("*.jsonl")) if each.name != "errors.jsonl")
        raise ValueError(f"{path} is a folder; name a results file in it{f': {files}' if files else ''}")
    if not path.is_file():
        raise ValueError(
            f"{path}: no such results file; lerobot-eval writes it with --env.results_path={path}"
        )
    rows: dict[int, Row] = {}
    damages = []
    for number, line in enumerate(path.read_bytes().split(b"\n"), start=1):
        if not line.strip():
            continue
        try:
            rows[number] = parse_line(line)
        except (ValueError, RecursionError) as error:
            damages.append(f"{path}:{number}: not an episode result: {error}")
    return rows, damages


def check_any(path: Path, rows: Collection[object], damages: list[str]) -> None:
    """Raise a ValueError unless there are rows of this file; damages: what is wrong with its other lines."""
    if not rows and damages:
        raise ValueError(f"{path} is no results file; name one that --env.results_path of lerobot-eval wrote")
    if not rows:
        raise ValueError(
            f"{path}: no finished episode; lerobot-eval writes a line when one ends: start it (again) with "
            f"--env.results_path={path}"
        )


def kind_of(row: Row) -> ResultKind:
    """Return the kind of results that a record is of."""
    return KIND_OF_VERSION[row["protocol_version"]]


def parse_line(line: bytes) -> Row:
    """An episode's fields.

    Raises:
        ValueError: the line is not JSON, or a field is missing, mistyped or impossible.
    """
    try:
        text = line.decode()  # of bytes, json reads halves of surrogate pairs, too
        row = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"{error.msg.removesuffix(' at')} at column {error.colno}") from None
    if not isinstance(row, dict):
        raise ValueError("no JSON object")
    if "\\u" in text:  # halves of surrogate pairs come from escapes alone
        check_text(row)
    version = row.get("protocol_version")
    if version not in list(KIND_OF_VERSION):
        raise ValueError(f"protocol_version {version!r}; this package reads {', '.join(KIND_OF_VERSION)}")
    kind = kind_of(row)
    kind.check(row)
    if row.get("policy") is not None:
        added = {name: check for name, check in ADDED_POLICY_CHECKS.items() if name in row["policy"]}
        check_fields(row["policy"], POLICY_CHECKS | added, "policy.")
        _check_batch(row["policy"])
    if row["is_success"] != (row["failure"] is None):
        raise ValueError(f"is_success={row['is_success']} with failure={row['failure']!r}")
    kind.check_spec(row)
    return row
