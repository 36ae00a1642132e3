"""Records of results files, of whichever environment: read and checked."""

import json
from collections.abc import Collection
from functools import cache
from pathlib import Path
from typing import Any

from lerobot_bomb.results.bomb import EpisodeResult
from lerobot_bomb.results.libero import LiberoResult
from lerobot_bomb.results.pusht import PushTResult
from lerobot_bomb.results.record import Record
from lerobot_bomb.results.schema import Schema
from lerobot_bomb.results.stock import StockLiberoResult, StockPushTResult

RECORD_TYPES: tuple[type[Record], ...] = (
    EpisodeResult,
    PushTResult,
    LiberoResult,
    StockPushTResult,
    StockLiberoResult,
)
RECORD_OF_ENV: dict[str, type[Record]] = {each.env_type: each for each in RECORD_TYPES}
RECORD_OF_VERSION: dict[str, type[Record]] = {
    version: each for each in RECORD_TYPES for version in each.versions
}


@cache
def _schema(record_type: type[Record], version: str) -> Schema[Record]:
    """Schema of the records of a protocol version; what only other versions lack must be there."""
    of_others = {name for names in record_type.versions.values() for name in names}
    must_have = of_others - set(record_type.versions[version])
    lacking = {name: value for name, value in record_type.earlier.items() if name not in must_have}
    return Schema(record_type, lacking, closed=("spec",))


def read_records(path: Path) -> tuple[dict[int, Record], list[str]]:
    """Return {line number, from 1: record} of a results file, and what is wrong with its other lines.

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
    records: dict[int, Record] = {}
    damages = []
    with path.open("rb") as file:
        for number, line in enumerate(file, start=1):
            if not line.strip():
                continue
            try:
                records[number] = parse_record(line.removesuffix(b"\n"))
            except (ValueError, RecursionError) as error:
                damages.append(f"{path}:{number}: not an episode result: {error}")
    return records, damages


def check_any(path: Path, records: Collection[object], damages: list[str]) -> None:
    """Raise a ValueError unless a file has records; damages: what is wrong with its other lines."""
    if not records and damages:
        raise ValueError(f"{path} is no results file; name one that --env.results_path of lerobot-eval wrote")
    if not records:
        raise ValueError(
            f"{path}: no finished episode; lerobot-eval writes a record when one ends: start it (again) with "
            f"--env.results_path={path}"
        )


def parse_record(line: bytes) -> Record:
    """Read a record.

    Raises:
        ValueError: the line is not JSON, or a field is missing, mistyped or impossible.
    """
    try:
        text = line.decode()  # of bytes, json reads halves of surrogate pairs, too
        values = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"{error.msg.removesuffix(' at')} at column {error.colno}") from None
    if not isinstance(values, dict):
        raise ValueError("no JSON object")
    if "\\u" in text:  # halves of surrogate pairs come from escapes alone
        _check_text(values)
    version = values.get("protocol_version")
    if version not in list(RECORD_OF_VERSION):
        raise ValueError(f"protocol_version {version!r}; this package reads {', '.join(RECORD_OF_VERSION)}")
    record = _schema(RECORD_OF_VERSION[version], version).read(values)
    record.check()
    return record


def _check_text(value: Any) -> None:
    """Raise a ValueError unless all text of a JSON value can be written again."""
    try:
        json.dumps(value, ensure_ascii=False).encode()
    except UnicodeEncodeError as error:
        raise ValueError(f"text with half a surrogate pair, {error.object[error.start]!a}") from None
