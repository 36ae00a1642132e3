"""Records of `bomb_pusht` in a results file: what each must say, and what they say together."""

from functools import partial
from typing import Any

import numpy as np

from lerobot_bomb.bootstrap import bca_interval, format_bounds
from lerobot_bomb.envs.results import Row
from lerobot_bomb.evaluation.line_checks import (
    RUN_CHECKS,
    Check,
    is_bool,
    is_int,
    is_number,
    is_one_of,
    is_quantity,
    is_table_of,
    is_text,
    or_none,
    refuse_if,
)
from lerobot_bomb.evaluation.result_kind import (
    Measure,
    Pair,
    ResultKind,
    describe_versions,
    mean_with_interval,
)
from lerobot_bomb.pusht.episode import (
    ALMOST_COVERAGE,
    MAX_IMAGE_SIZE,
    MIN_IMAGE_SIZE,
    PUSHT_PROTOCOL_VERSION,
    SUCCESS_COVERAGE,
    PushTFailure,
    PushTSpec,
)
from lerobot_bomb.pusht.perturbations import PushTCondition


def is_share(value: Any) -> bool:
    """Return True for a number in 0..1; rounding may take a covered area past the target's."""
    return is_quantity(value) and value <= 1 + 1e-9


def is_pose(value: Any) -> bool:
    """Return True for [x, y, angle]."""
    return isinstance(value, list) and len(value) == 3 and all(map(is_number, value))


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
    **RUN_CHECKS,
}


def _check_episode(row: Row) -> None:
    PushTSpec(**row["spec"])
    if row["steps"] > row["spec"]["max_steps"]:
        raise ValueError(f"steps={row['steps']} is impossible with spec.max_steps={row['spec']['max_steps']}")
    refuse_if(row["coverage"] > row["max_coverage"], row, "coverage", "max_coverage")
    is_covered = row["coverage"] > SUCCESS_COVERAGE
    refuse_if(is_covered != row["is_success"], row, "coverage", "is_success")
    is_almost = row["failure"] == PushTFailure.ALMOST and row["coverage"] < ALMOST_COVERAGE
    refuse_if(is_almost, row, "coverage", "failure")


def _settings(row: Row) -> dict[str, str]:
    return {"simulator": describe_versions(row)}


def _eval_flags(rows: list[Row]) -> list[str]:
    names = ("instruction", "max_steps")
    flags = {name: rows[0]["spec"][name] for name in names} | {"image_size": rows[0]["image_size"]}
    return ["--env.type=bomb_pusht", *(f"--env.{name}={value}" for name, value in flags.items())]


def _values(rows: list[Row], name: str) -> np.ndarray:
    return np.array([row[name] for row in rows])


def _coverage_change(pairs: list[Pair]) -> str:
    """'max coverage -0.120 [-0.200, -0.040]': the mean change of (unperturbed, perturbed) pairs."""
    before, after = (_values(rows, "max_coverage") for rows in map(list, zip(*pairs, strict=True)))
    interval = bca_interval(after - before, np.ones(len(pairs)))
    return f"max coverage {(after - before).mean():+.3f}{format_bounds(interval, '+.3f')}"


PUSHT_LINES = ResultKind(
    env_type="bomb_pusht",
    condition=PushTCondition,
    fields={PUSHT_PROTOCOL_VERSION: PUSHT_CHECKS},
    spec_fields=PUSHT_SPEC_CHECKS,
    check_episode=_check_episode,
    drawn=(),
    settings=_settings,
    describe_simulator=lambda settings: settings["simulator"],
    describe_tasks=lambda rows: "task pusht",
    benchmark=lambda _: f"PushT with BOMB's axes, protocol {PUSHT_PROTOCOL_VERSION}",
    environment=lambda row: None,
    eval_flags=_eval_flags,
    measures=[
        Measure(
            "max coverage",
            partial(mean_with_interval, name="max_coverage"),
            "mean, 95 % bootstrap interval over episodes",
        ),
        Measure("final coverage", partial(mean_with_interval, name="coverage")),
    ],
    describe_change=_coverage_change,
    tasks=("pusht",),
)
