"""Records of `bomb_libero` in a results file: what each must say, and what they say together."""

from lerobot_bomb.envs.results import Row
from lerobot_bomb.evaluation.line_checks import (
    RUN_CHECKS,
    Check,
    is_bool,
    is_int,
    is_one_of,
    is_table_of,
    is_text,
    or_none,
)
from lerobot_bomb.evaluation.result_kind import ResultKind, describe_numbers, describe_versions
from lerobot_bomb.libero.assets import SUITES
from lerobot_bomb.libero.episode import LIBERO_PROTOCOL_VERSION, LiberoFailure, LiberoSpec
from lerobot_bomb.libero.perturbations import LiberoCondition

LIBERO_SPEC_CHECKS: dict[str, Check] = {  # the rest is LiberoSpec's own
    "seed": is_int(0),
    "suite": is_text,
    "task_id": is_int(0),
    "max_steps": or_none(is_int(1)),
    "perturbations": is_text,
}
LIBERO_CHECKS: dict[str, Check] = {
    "spec": lambda value: isinstance(value, dict),
    "instruction": is_text,
    "initial_state": is_int(0),
    "steps": is_int(1),
    "is_success": is_bool,
    "failure": or_none(is_one_of(LiberoFailure)),
    "levels": is_table_of(is_int(0)),
    "image_size": is_text,
    "control_mode": is_text,
    "fps": is_int(1),
    **RUN_CHECKS,
}


def _check_episode(row: Row) -> None:
    LiberoSpec(**row["spec"])
    most = row["spec"]["max_steps"]
    if most is not None and row["steps"] > most:
        raise ValueError(f"steps={row['steps']} is impossible with spec.max_steps={most}")


def _settings(row: Row) -> dict[str, str]:
    return {
        "simulator": describe_versions(row),
        "control_mode": row["control_mode"],
        "fps": str(row["fps"]),
    }


def _describe_tasks(rows: list[Row]) -> str:
    """'libero_spatial tasks 0..2'."""
    suites = dict.fromkeys(row["spec"]["suite"] for row in rows)
    numbers = {
        suite: {row["spec"]["task_id"] for row in rows if row["spec"]["suite"] == suite} for suite in suites
    }
    return ", ".join(f"{suite} tasks {describe_numbers(ids)}" for suite, ids in numbers.items())


def _eval_flags(rows: list[Row]) -> list[str]:
    first = rows[0]
    width, height = first["image_size"].split("x")
    suites = dict.fromkeys(row["spec"]["suite"] for row in rows)
    flags = {
        "task": ",".join(suites),
        "task_ids": sorted({row["spec"]["task_id"] for row in rows}),
        "control_mode": first["control_mode"],
        "fps": first["fps"],
        "observation_height": height,
        "observation_width": width,
    }
    steps = first["spec"]["max_steps"]
    flags |= {} if steps is None else {"episode_length": steps}
    return ["--env.type=bomb_libero", *(f"--env.{name}={value}" for name, value in flags.items())]


LIBERO_LINES = ResultKind(
    env_type="bomb_libero",
    condition=LiberoCondition,
    fields={LIBERO_PROTOCOL_VERSION: LIBERO_CHECKS},
    spec_fields=LIBERO_SPEC_CHECKS,
    check_episode=_check_episode,
    drawn=("task_id",),
    start=("seed", "task_id"),  # tasks have scenes of their own
    settings=_settings,
    describe_simulator=lambda settings: (
        f"{settings['control_mode']} control, {settings['fps']} Hz, {settings['simulator']}"
    ),
    describe_tasks=_describe_tasks,
    benchmark=lambda _: f"LIBERO with BOMB's axes, protocol {LIBERO_PROTOCOL_VERSION}",
    environment=lambda row: None,
    eval_flags=_eval_flags,
    measures=(),
    tasks=SUITES,
)
