"""Records of LeRobot's own `pusht` and `libero` in a results file: what each must say, and what they say."""

import json
from collections.abc import Mapping
from functools import partial
from typing import Any, ClassVar

from lerobot_bomb.conditions import NONE, Axis, AxisCondition
from lerobot_bomb.envs.results import Row
from lerobot_bomb.envs.stock_results import FAILED, STOCK_PROTOCOLS
from lerobot_bomb.evaluation.line_checks import (
    RUN_CHECKS,
    Check,
    is_bool,
    is_int,
    is_number,
    is_one_of,
    is_table_of,
    is_text,
    or_none,
)
from lerobot_bomb.evaluation.result_kind import (
    Measure,
    ResultKind,
    describe_numbers,
    describe_versions,
    mean_with_interval,
)
from lerobot_bomb.libero.assets import SUITES


class NoCondition(AxisCondition):
    """Condition of an environment without perturbation axes: `none` only."""

    axes: ClassVar[Mapping[str, Axis]] = {}


SPEC_CHECKS: dict[str, Check] = {
    "seed": is_int(0),
    "suite": is_text,
    "task_id": is_int(0),
    "number": or_none(is_int(0)),
    "perturbations": is_one_of((NONE,)),
}
CHECKS: dict[str, Check] = {
    "spec": lambda value: isinstance(value, dict),
    "sum_reward": is_number,
    "max_reward": is_number,
    "is_success": is_bool,
    "failure": or_none(is_one_of((FAILED,))),
    "image_size": is_text,
    "flags": lambda value: isinstance(value, dict),
    "levels": is_table_of(is_int(0)),
    **RUN_CHECKS,
}
START = ("seed", "task_id")  # tasks have scenes of their own


def _settings(row: Row) -> dict[str, str]:
    flags = {name: json.dumps(value) for name, value in sorted(row["flags"].items()) if value is not None}
    return {"simulator": describe_versions(row), **flags}


def _describe_tasks(rows: list[Row]) -> str:
    """'libero_spatial tasks 0..2'."""
    numbers: dict[str, set[int]] = {}
    for row in rows:
        numbers.setdefault(row["spec"]["suite"], set()).add(row["spec"]["task_id"])
    return ", ".join(f"{suite} tasks {describe_numbers(ids)}" for suite, ids in numbers.items())


def _eval_flags(env_type: str, rows: list[Row]) -> list[str]:
    flags = {name: value for name, value in rows[0]["flags"].items() if value is not None}
    if env_type == "libero":
        flags["task"] = ",".join(dict.fromkeys(row["spec"]["suite"] for row in rows))
        flags["task_ids"] = sorted({row["spec"]["task_id"] for row in rows})
    return [
        f"--env.type={env_type}",
        *(f"--env.{name}={_flag_value(value)}" for name, value in flags.items()),
        "--eval.use_async_envs=false",
    ]


def _flag_value(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _stock_lines(env_type: str, tasks: tuple[str, ...], starts_by_number: bool) -> ResultKind:
    return ResultKind(
        env_type=env_type,
        condition=NoCondition,
        fields={STOCK_PROTOCOLS[env_type]: CHECKS},
        spec_fields=SPEC_CHECKS,
        check_episode=lambda row: None,
        drawn=("task_id", "number"),
        start=START,
        settings=_settings,
        describe_simulator=lambda settings: settings["simulator"],
        describe_tasks=_describe_tasks,
        benchmark=lambda _: f"LeRobot's {env_type}",
        environment=lambda row: None,
        eval_flags=partial(_eval_flags, env_type),
        measures=[
            Measure(name, partial(mean_with_interval, name=field, start=START), "mean over episodes")
            for name, field in (("max reward", "max_reward"), ("sum of rewards", "sum_reward"))
        ],
        tasks=tasks,
        has_results_path=False,
        starts_by_number=starts_by_number,
    )


STOCK_PUSHT_LINES = _stock_lines("pusht", ("PushT-v0",), starts_by_number=False)
STOCK_LIBERO_LINES = _stock_lines("libero", SUITES, starts_by_number=True)
