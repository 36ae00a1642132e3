"""Lines of `bomb_pusht` in a results file: what each must say, and what they say together."""

from collections import Counter
from typing import Any

import numpy as np

from lerobot_bomb.evaluation.line_checks import (
    Check,
    check_fields,
    is_bool,
    is_int,
    is_one_of,
    is_quantity,
    is_table_of,
    is_text,
    or_none,
    refuse_others,
)
from lerobot_bomb.pusht.episode import (
    MAX_IMAGE_SIZE,
    MIN_IMAGE_SIZE,
    PUSHT_PROTOCOL_VERSION,
    PushTFailure,
    PushTSpec,
)
from lerobot_bomb.stats import bootstrap_interval, format_rate, paired_bootstrap_interval


def is_share(value: Any) -> bool:
    """Whether a value is a number in 0..1; rounding may take a covered area past the target's."""
    return is_quantity(value) and value <= 1 + 1e-9


def is_pose(value: Any) -> bool:
    """Whether a value is [x, y, angle]."""
    return isinstance(value, list) and len(value) == 3 and all(is_quantity(abs(number)) for number in value)


PUSHT_SPEC_CHECKS: dict[str, Check] = {  # the rest is PushTSpec's own
    "seed": is_int(0),
    "instruction": is_text,
    "max_steps": is_int(1),
    "perturbations": is_text,
}
PUSHT_CHECKS: dict[str, Check] = {
    "spec": lambda value: isinstance(value, dict),
    "instruction": is_text,
    "goal_pose": is_pose,
    "steps": is_int(1),
    "is_success": is_bool,
    "failure": or_none(is_one_of(PushTFailure)),
    "coverage": is_share,
    "max_coverage": is_share,
    "levels": is_table_of(is_int(0)),
    "image_size": is_int(MIN_IMAGE_SIZE, MAX_IMAGE_SIZE),
    "policy": or_none(lambda value: isinstance(value, dict)),
    "simulator_versions": is_table_of(or_none(is_text)),
    "machine": is_text,
    "lerobot_version": or_none(is_text),
    "torch_version": or_none(is_text),
    "package_version": is_text,
}

type PushTRow = dict[str, Any]  # the fields of PushTResult


def is_of_pusht(row: PushTRow) -> bool:
    """Whether a line is of `bomb_pusht`."""
    return row["protocol_version"] == PUSHT_PROTOCOL_VERSION


def check_pusht_spec(spec: dict[str, Any]) -> None:
    """Raise a ValueError unless there can be such an episode."""
    check_fields(spec, PUSHT_SPEC_CHECKS, "spec.")
    refuse_others(spec, PUSHT_SPEC_CHECKS)
    PushTSpec(**spec)


def simulator_of(row: PushTRow) -> str:
    """'gym-pusht 0.1.8, pymunk 6.11.1, ...': what the bits of an episode depend on."""
    return ", ".join(f"{name} {version or '?'}" for name, version in row["simulator_versions"].items())


def pusht_summary(rows: list[PushTRow]) -> list[str]:
    """Success, coverage and failures as text, a line each."""
    failures = Counter(row["failure"] for row in rows if not row["is_success"])
    counts = ", ".join(f"{name} {count}" for name, count in failures.most_common()) or "none"
    best, final = (np.array([row[name] for row in rows]) for name in ("max_coverage", "coverage"))
    return [
        f"success          {format_rate(sum(row['is_success'] for row in rows), len(rows))} "
        "(95 % Wilson interval)",
        f"max coverage     {_mean(best)} (mean, 95 % bootstrap interval over episodes)",
        f"final coverage   {_mean(final)}",
        f"failures         {counts}",
    ]


def coverage_change(pairs: list[tuple[PushTRow, PushTRow]]) -> str:
    """'max coverage -0.120 [-0.200, -0.040]': the mean change of (unperturbed, perturbed) pairs."""
    before, after = np.array([[row["max_coverage"] for row in pair] for pair in pairs]).T
    ones = np.ones(len(pairs))
    interval = paired_bootstrap_interval((before, ones), (after, ones))
    return f"max coverage {(after - before).mean():+.3f}{_bounds(interval, '+.3f')}"


def _mean(values: np.ndarray) -> str:
    return f"{values.mean():.3f}{_bounds(bootstrap_interval(values, np.ones(len(values))), '.3f')}"


def _bounds(interval: tuple[float, float] | None, form: str) -> str:
    """' [low, high]'; nothing for a single episode."""
    return "" if interval is None else f" [{interval[0]:{form}}, {interval[1]:{form}}]"
