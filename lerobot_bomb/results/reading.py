"""Reading and checking of results files of any environment."""

import json
import re
from collections.abc import Collection
from functools import cache
from pathlib import Path
from typing import Any

from lerobot_bomb.environments import ENVIRONMENTS
from lerobot_bomb.results.record import Record
from lerobot_bomb.results.schema import Schema
from lerobot_bomb.results.stock import unregistered_result

STOCK_VERSION = r"lerobot-(\w+)-1\.0"  # of an env type of LeRobot's own


@cache
def record_type_of(version: str) -> type[Record] | None:
    """Return the type of the records of a protocol version; None: no environment has it."""
    types = (each.record for each in ENVIRONMENTS.values())
    stock = re.fullmatch(STOCK_VERSION, version)
    return next((each for each in types if version in each.versions), stock and unregistered_result(stock[1]))


@cache
def _schema(record_type: type[Record], version: str) -> Schema[Record]:
    """Return the schema of a protocol version."""
    return Schema(record_type, _may_lack(record_type, version), closed=("spec",))


def _may_lack(record_type: type[Record], version: str) -> dict[str, Any]:
    """Return {field that records of a protocol version may lack: its value then}."""
    of_others = {name for names in record_type.versions.values() for name in names}
    must_have = of_others - set(record_type.versions[version])
    return {name: value for name, value in record_type.earlier.items() if name not in must_have}


def line_of(record: Record) -> str:
    """Return a line from which `parse_record` reads an equal record, of whichever release that was.

    A value that stands for a missing field need not be possible, so it is left out.
    """
    values = record.as_json()
    for name, value in _may_lack(type(record), record.protocol_version).items():
        outer, _, inner = name.rpartition(".")
        fields = values[outer] if outer else values
        if fields is not None and fields[inner] == value:
            del fields[inner]
    return json.dumps(values, allow_nan=False)


def read_records(path: Path) -> tuple[dict[int, Record], list[str]]:
    """Return {line number, from 1: record} of a results file, and the damage of its other lines.

    Raises:
        ValueError: there is no such file, or it is a folder.
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
    """Raise a ValueError unless a file has records; `damages` are those of its other lines."""
    if not records and damages:
        raise ValueError(f"{path} is no results file; name one that --env.results_path of lerobot-eval wrote")
    if not records:
        raise ValueError(
            f"{path}: no finished episode; a record is written when one ends. Start lerobot-eval again with "
            "this --env.results_path, or resume the sweep of this folder"
        )


def parse_record(line: bytes) -> Record:
    """Read a record.

    Raises:
        ValueError: the line is not JSON, or a field is missing, mistyped or impossible.
    """
    try:
        text = line.decode()  # from bytes, json would read halves of surrogate pairs, too
        values = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"{error.msg.removesuffix(' at')} at column {error.colno}") from None
    if not isinstance(values, dict):
        raise ValueError("no JSON object")
    if "\\u" in text:  # halves of surrogate pairs come from escapes alone
        _check_text(values)
    version = values.get("protocol_version")
    record_type = record_type_of(version) if isinstance(version, str) else None
    if record_type is None:
        known = [each for env in ENVIRONMENTS.values() for each in env.record.versions]
        raise ValueError(f"protocol_version {version!r}; this package reads {', '.join(known)}")
    record = _schema(record_type, version).read(values)
    record.check()
    return record


def _check_text(value: Any) -> None:
    """Raise a ValueError unless all text of a JSON value can be written again."""
    try:
        json.dumps(value, ensure_ascii=False).encode()
    except UnicodeEncodeError as error:
        raise ValueError(f"text with half a surrogate pair, {error.object[error.start]!a}") from None
