"""Checks of the fields of a record."""

import json
import math
import re
from collections.abc import Callable, Mapping
from typing import Any

from lerobot_bomb.conditions import AxisCondition
from lerobot_bomb.tables import printable

SHOWN_CHARACTERS = 80  # of a wrong value

type Check = Callable[[Any], bool]


def is_int(low: int, high: float = math.inf) -> Check:
    """Return a check for a whole number in low..high; true and false are none."""
    return lambda value: type(value) is int and low <= value <= high


def is_bool(value: Any) -> bool:
    """Return True for true and false."""
    return type(value) is bool


def is_text(value: Any) -> bool:
    """Return True for a text."""
    return isinstance(value, str)


def is_number(value: Any) -> bool:
    """Return True for a finite number."""
    return type(value) in (int, float) and math.isfinite(value)


def is_quantity(value: Any) -> bool:
    """Return True for a finite number that is not negative."""
    return is_number(value) and value >= 0


def is_positive(value: Any) -> bool:
    """Return True for a finite number above 0."""
    return is_quantity(value) and value > 0


def is_share(value: Any) -> bool:
    """Return True for a number in 0..1."""
    return is_quantity(value) and value <= 1


def or_none(check: Check) -> Check:
    """Return a check for null or a value that passes."""
    return lambda value: value is None or check(value)


def is_list_of(check: Check) -> Check:
    """Return a check for a list, not empty, of values that pass."""
    return lambda value: isinstance(value, list) and bool(value) and all(map(check, value))


def is_table_of(check: Check) -> Check:
    """Return a check for an object whose values pass."""
    return lambda value: isinstance(value, dict) and all(map(check, value.values()))


def is_one_of(values: Any) -> Check:
    """Return a check for one of these texts."""
    allowed = frozenset(map(str, values))
    return lambda value: isinstance(value, str) and value in allowed


def is_sha256(value: Any) -> bool:
    """Return True for a text of 64 hexadecimal digits."""
    return isinstance(value, str) and re.fullmatch("[0-9a-f]{64}", value) is not None


def is_object_of(checks: Mapping[str, Check]) -> Check:
    """Return a check for an object with these keys, each of which passes; others are not looked at."""

    def is_possible(value: Any) -> bool:
        has_all = isinstance(value, dict) and checks.keys() <= value.keys()
        return has_all and all(check(value[name]) for name, check in checks.items())

    return is_possible


# what lines of all environments have since they are measured, and earlier ones do not
SHARED_CHECKS: dict[str, Check] = {
    "action_j2": or_none(is_quantity),
    "action_j3": or_none(is_quantity),
    "inference": or_none(
        is_object_of(
            {
                "num_queries": is_int(1),
                "total_s": is_positive,
                "latency_p50_ms": is_positive,
                "latency_p95_ms": is_positive,
                "passes": or_none(is_quantity),
                "tokens": or_none(is_quantity),
                "num_parameters": is_int(1),
                "peak_memory_bytes": or_none(is_int(1)),
                "device": is_text,
            }
        )
    ),
}
# of who acted, on what and with what, in lines whose simulator is several packages
RUN_CHECKS: dict[str, Check] = {
    "policy": or_none(lambda value: isinstance(value, dict)),
    "simulator_versions": is_table_of(or_none(is_text)),
    "machine": is_text,
    "lerobot_version": or_none(is_text),
    "torch_version": or_none(is_text),
    "package_version": is_text,
}


def check_levels(row: Mapping[str, Any], condition: type[AxisCondition]) -> None:
    """Raise a ValueError unless a record's levels can be those of its condition."""
    asked = {axis: (low, high) for axis, low, high in condition.parse(row["spec"]["perturbations"]).ranges}
    levels = {axis: row["levels"].get(axis, 0) for axis in (*row["levels"], *asked)}
    off = (0, 0)  # of an axis that is not in the condition
    for axis, level in levels.items():
        low, high = asked.get(axis, off)
        if not low <= level <= high:
            raise ValueError(
                f"levels={json.dumps(row['levels'])} with spec.perturbations={row['spec']['perturbations']}"
            )


def check_inference(row: Mapping[str, Any]) -> None:
    """Raise a ValueError unless an episode can have had such queries."""
    measured = row.get("inference")
    if measured is None:
        return
    named = {f"inference.{name}": value for name, value in measured.items()} | {"steps": row.get("steps")}
    is_unordered = measured["latency_p50_ms"] > measured["latency_p95_ms"]
    refuse_if(is_unordered, named, "inference.latency_p50_ms", "inference.latency_p95_ms")
    is_too_often = "steps" in row and measured["num_queries"] > row["steps"]
    refuse_if(is_too_often, named, "inference.num_queries", "steps")


def refuse_if(is_impossible: bool, values: Mapping[str, Any], first: str, *others: str) -> None:
    """Raise a ValueError that shows fields which, each possible, are not so together."""
    if is_impossible:
        shown = [f"{name}={json.dumps(values[name])[:SHOWN_CHARACTERS]}" for name in (first, *others)]
        raise ValueError(f"{shown[0]} is impossible{' with ' * bool(others)}{', '.join(shown[1:])}")


def check_text(value: Any) -> None:
    """Raise a ValueError unless all text of a JSON value can be written again."""
    try:
        json.dumps(value, ensure_ascii=False).encode()
    except UnicodeEncodeError as error:
        raise ValueError(f"text with half a surrogate pair, {error.object[error.start]!a}") from None


def refuse_others(spec: dict[str, Any], checks: Mapping[str, Check]) -> None:
    """Raise a ValueError if a spec has a field that no check is for: then it may be of another episode."""
    unknown = spec.keys() - checks.keys()
    if unknown:
        raise ValueError(
            f"spec has {', '.join(map(printable, sorted(unknown)))}, of which this package knows nothing"
        )


def check_fields(values: dict[str, Any], checks: Mapping[str, Check], prefix: str = "") -> None:
    """Raise a ValueError that names the fields that are missing, or the first that is impossible."""
    missing = [f"{prefix}{name}" for name in checks if name not in values]
    if missing:
        raise ValueError(f"it lacks {', '.join(missing)}")
    for name, is_possible in checks.items():
        if not is_possible(values[name]):
            shown = json.dumps(values[name])
            if len(shown) > SHOWN_CHARACTERS:
                shown = f"{shown[:SHOWN_CHARACTERS]}..."
            raise ValueError(f"{prefix}{name}={shown} is impossible")
