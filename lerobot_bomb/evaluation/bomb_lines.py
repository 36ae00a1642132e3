"""Records of `bomb` in a results file: what each must say, whichever protocol wrote it, and what all say."""

from collections.abc import Mapping
from statistics import mean, median
from typing import Any

import numpy as np

from lerobot_bomb.bomb.board import BOARD, COLORS, task_id
from lerobot_bomb.bomb.episode import PROTOCOL_VERSION, EpisodeSpec, Failure, Stage
from lerobot_bomb.bomb.observation import CAMERAS, MAX_IMAGE_SIZE, MIN_IMAGE_SIZE, RENDER_PRESETS
from lerobot_bomb.bomb.perturbations import Condition
from lerobot_bomb.bomb.suite import FIRST_VERSION, find_suite
from lerobot_bomb.bomb.suites import SUITES
from lerobot_bomb.bootstrap import bca_interval, format_bounds, sums_by
from lerobot_bomb.conditions import ALL
from lerobot_bomb.data.environment import Environment, numbered_tasks
from lerobot_bomb.envs.results import Row
from lerobot_bomb.evaluation.bomb_outcomes import check_outcome
from lerobot_bomb.evaluation.line_checks import (
    Check,
    is_bool,
    is_int,
    is_list_of,
    is_one_of,
    is_quantity,
    is_share,
    is_table_of,
    is_text,
    or_none,
)
from lerobot_bomb.evaluation.result_kind import (
    NO_VALUE,
    NOT_RECORDED,
    Measure,
    Pair,
    ResultKind,
    describe_numbers,
    json_list,
)
from lerobot_bomb.flags import one_of

OLD_VERSION = "1.0"  # whose lines say less
NUM_TASKS = len(COLORS) * BOARD.num_lines**2
# outcomes of an episode in which the stone was carried and put down somewhere on the board
PUT_DOWN = (None, Failure.WRONG_INTERSECTION, Failure.IMPRECISE, Failure.DISTURBED_OTHERS)


def put_down(rows: list[Row]) -> list[Row]:
    """Return the records in which the stone was carried and put down on the board."""
    return [row for row in rows if row["failure"] in PUT_DOWN]


def is_grounded(row: Row) -> bool:
    """Return True if the stone, put down on the board, lies nearest to the intersection that was named."""
    return row["nearest_intersection"] == row["target"]


def named_targets(rows: list[Row]) -> dict[str, Any]:
    """{instruction: what it asks for}: in `place` its intersection; elsewhere that depends on the board."""

    def target(row: Row) -> Any:
        return row["target"] if row["spec"]["suite"] == "place" else row["instruction"]

    return {row["instruction"]: target(row) for row in rows}


def other_instructions(rows: list[Row]) -> dict[str, str]:
    """{instruction: another, which asks for something else where there is one}; {} where all ask the same."""
    targets = named_targets(rows)
    first, *others = targets.values()
    if all(other == first for other in others):
        return {}
    instructions = sorted(targets)

    def shifted(places: int) -> dict[str, str]:
        return dict(zip(instructions, instructions[places:] + instructions[:places], strict=True))

    def num_others(given: dict[str, str]) -> int:
        return sum(targets[instruction] != targets[other] for instruction, other in given.items())

    return max(map(shifted, range(1, len(instructions))), key=num_others)


_is_line = is_int(0, BOARD.num_lines - 1)


def is_intersection(value: Any) -> bool:
    """Return True for [row, column] on the board."""
    return isinstance(value, list) and len(value) == 2 and all(map(_is_line, value))


SPEC_CHECKS: dict[str, Check] = {  # the rest is EpisodeSpec's own
    "seed": is_int(0),
    "suite": is_text,
    "robot": is_text,
    "split": is_text,
    "control_mode": is_text,
    "fps": is_int(1),
    "target": or_none(is_intersection),
    "color": or_none(is_text),
    "success_tolerance_mm": is_quantity,
    "perturbations": is_text,
}
CHECKS: dict[str, Check] = {
    "spec": lambda value: isinstance(value, dict),
    "instruction": is_text,
    "target": or_none(is_intersection),
    "color": or_none(is_one_of(COLORS)),
    "steps": is_int(1),
    "is_success": is_bool,
    "is_success_bomb_v0": is_bool,
    "failure": or_none(is_one_of(Failure)),
    "stage": is_one_of(Stage),
    "placement_error_mm": is_quantity,
    "nearest_intersection": is_intersection,
    "collateral_mm": is_quantity,
    "levels": is_table_of(is_int(0)),
    "image_size": is_int(MIN_IMAGE_SIZE, MAX_IMAGE_SIZE),
    "package_version": is_text,
}
NEW_CHECKS: dict[str, Check] = {  # of what protocol 1.1 added
    "policy": or_none(lambda value: isinstance(value, dict)),
    "mujoco_version": or_none(is_text),
    "opengl_vendor": or_none(is_text),
    "opengl_renderer": or_none(is_text),
    "machine": is_text,
    "render_preset": is_one_of(RENDER_PRESETS),
    "task_ids": or_none(is_list_of(is_int(0, NUM_TASKS - 1))),
    "lerobot_version": or_none(is_text),
    "torch_version": or_none(is_text),
    "task_version": is_text,
}


def median_error_mm(rows: list[Row]) -> float | None:
    """Return the median error of the stones that were put down on the board; None: there are none."""
    errors = [row["placement_error_mm"] for row in rows if row["failure"] in PUT_DOWN]
    return median(errors) if errors else None


def _placement_error(rows: list[Row]) -> str:
    error_mm = median_error_mm(rows)
    return NO_VALUE if error_mm is None else f"{error_mm:.1f} mm"


def _error_change(pairs: list[Pair]) -> str:
    """'placement error +1.2 mm [+0.3, +2.0] where both put it down (40 pairs)'; '' where there are none."""
    both = [pair for pair in pairs if all(row["failure"] in PUT_DOWN for row in pair)]
    if not both or any(row["target"] is None for pair in both for row in pair):
        return ""
    changes_mm = np.array(
        [after["placement_error_mm"] - before["placement_error_mm"] for before, after in both]
    )
    interval = bca_interval(*sums_by(changes_mm, [row["spec"]["seed"] for row, _ in both]))
    change = f"placement error {changes_mm.mean():+.1f} mm{format_bounds(interval, '+.1f')}"
    return f"{change} where both put the stone down ({len(both)} pairs)"


def _progress(rows: list[Row]) -> str:
    """Return the mean progress of episodes of several moves, as text."""
    shares = [row["progress"] for row in rows if row["target"] is None]
    return f"{100 * mean(shares):.1f} %" if shares else NO_VALUE


def spec_of(row: Row) -> EpisodeSpec:
    """Rebuild the EpisodeSpec of a record.

    Raises:
        ValueError: there can be no such episode.
    """
    target = row["spec"]["target"]
    return EpisodeSpec(**row["spec"] | {"target": target and tuple(target)})


def task_version_of(row: Row) -> str:
    """Return the task version of a record's suite; records of protocol 1.0 name none."""
    return row.get("task_version", FIRST_VERSION)


def _check_episode(row: Row) -> None:
    spec_of(row)
    spec = row["spec"]
    versions = dict.fromkeys((FIRST_VERSION, find_suite(spec["suite"]).version))
    one_of(f"task_version of suite {spec['suite']}", task_version_of(row), tuple(versions))
    for name in ("target", "color"):
        if spec[name] not in (None, row[name]):
            raise ValueError(f"{name}={row[name]}, but spec.{name}={spec[name]}")
    check_outcome(row)


def _settings(row: Row) -> dict[str, str]:
    opengl = [name for name in (row.get("opengl_vendor"), row.get("opengl_renderer")) if name]
    return {
        "MuJoCo": row.get("mujoco_version") or NOT_RECORDED,
        "OpenGL": ", ".join(opengl) or NOT_RECORDED,
        "render_preset": row.get("render_preset", NOT_RECORDED),
        "tasks": _tasks_key(row),
        "task_version": task_version_of(row),
    }


def _tasks_key(row: Row) -> str:
    if row.get("task_ids") is not None:
        return json_list(*sorted(row["task_ids"]))
    target, color = (row["spec"][name] for name in ("target", "color"))
    if row["protocol_version"] == OLD_VERSION and target and color:
        return "fixed"  # lines of one evaluation of numbered tasks do not tell those of the others
    return json_list(target and tuple(target), color)


def _describe_simulator(settings: Mapping[str, str]) -> str:
    return (
        f"render_preset {settings['render_preset']}, OpenGL {settings['OpenGL']}, MuJoCo {settings['MuJoCo']}"
    )


def _describe_tasks(rows: list[Row]) -> str:
    """'tasks 0, 12', or target and colour, each fixed or drawn."""
    first = rows[0]
    if first.get("task_ids") is not None:
        return f"tasks {describe_numbers(first['task_ids'])}"
    target, color = (first["spec"][name] for name in ("target", "color"))
    if target and color:
        return f"tasks {describe_numbers(task_id(row['target'], row['color']) for row in rows)}"
    target = "drawn" if target is None else f"row {target[0]}, column {target[1]}"
    return f"target {target}; colour {color or 'drawn'}"


def environment_of_episode(row: Row) -> Environment:
    """Return the environment of a record's episode, without depth and tasks, which no record holds."""
    spec = row["spec"]
    return Environment(
        **{name: spec[name] for name in ("robot", "control_mode", "fps")},
        image_size=row["image_size"],
        cameras=CAMERAS,
        task_version=task_version_of(row),
        task=spec["suite"],
    )


def eval_flags_of(rows: list[Row]) -> list[str]:
    """Return lerobot-eval's flags for the environment and the tasks of an evaluation."""
    return [*environment_of_episode(rows[0]).eval_flags(), *_task_flags([row["spec"] for row in rows])]


def _task_flags(specs: list[dict[str, Any]]) -> list[str]:
    if ids := numbered_tasks(specs):
        return [f"--env.task_ids={list(ids)}".replace(" ", "")]
    shared = {name: specs[0][name] for name in ("target", "color") if specs[0][name] is not None}
    return [f"--env.{name}={value}".replace(" ", "") for name, value in shared.items()]


BOMB_LINES = ResultKind(
    env_type="bomb",
    condition=Condition,
    fields={OLD_VERSION: CHECKS, PROTOCOL_VERSION: CHECKS | NEW_CHECKS},
    spec_fields=SPEC_CHECKS,
    check_episode=_check_episode,
    added_spec_fields={"task_id": or_none(is_int(0))},
    added_fields={"task_id": is_int(0), "progress": is_share},
    drawn=("target", "color", "task_id"),
    settings=_settings,
    describe_simulator=_describe_simulator,
    describe_tasks=_describe_tasks,
    benchmark=lambda row: f"BOMB, task version {task_version_of(row)}",
    environment=environment_of_episode,
    eval_flags=eval_flags_of,
    describe_change=_error_change,
    tasks=(*SUITES, ALL),
    measures=[
        Measure("moves made", _progress, "mean share of an episode's moves"),
        Measure("placement error", _placement_error, "median of the stones that were put down"),
    ],
)
