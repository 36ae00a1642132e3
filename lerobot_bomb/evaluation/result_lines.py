"""Lines of a results file: what each must say, whichever version of the protocol wrote it."""

import json
from pathlib import Path
from typing import Any

from lerobot_bomb.bomb.board import BOARD, COLORS
from lerobot_bomb.bomb.episode import PROTOCOL_VERSION, TASK_VERSION, EpisodeSpec, Failure, Stage
from lerobot_bomb.bomb.observation import MAX_IMAGE_SIZE, MIN_IMAGE_SIZE, RENDER_PRESETS
from lerobot_bomb.evaluation.line_checks import (
    Check,
    check_fields,
    is_bool,
    is_int,
    is_list_of,
    is_one_of,
    is_quantity,
    is_sha256,
    is_table_of,
    is_text,
    or_none,
    refuse_others,
)
from lerobot_bomb.evaluation.pusht_lines import PUSHT_CHECKS, check_pusht_spec
from lerobot_bomb.pusht.episode import PUSHT_PROTOCOL_VERSION

OLD_VERSION = "1.0"  # whose lines say less
VERSIONS = (OLD_VERSION, PROTOCOL_VERSION, PUSHT_PROTOCOL_VERSION)
NUM_TASKS = len(COLORS) * BOARD.num_lines**2

type Row = dict[str, Any]  # the fields of EpisodeResult, or of PushTResult


def is_intersection(value: Any) -> bool:
    """Whether a value is [row, column] on the board."""
    return isinstance(value, list) and len(value) == 2 and all(map(is_int(0, BOARD.num_lines - 1), value))


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
    "target": is_intersection,
    "color": is_one_of(COLORS),
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
    "task_version": is_one_of((TASK_VERSION,)),
}
POLICY_CHECKS: dict[str, Check] = {
    "type": is_text,
    "path": or_none(is_text),
    "revision": or_none(is_text),
    "weights_sha256": or_none(is_sha256),
    "settings_sha256": or_none(is_sha256),
    "base": or_none(is_text),
    "is_in_training": is_bool,
}


def read_lines(path: Path) -> tuple[list[Row], list[str]]:
    """The episodes of a results file in its order, and what is wrong with its other lines.

    Raises:
        ValueError: there is no such file.
    """
    if not path.is_file():
        raise ValueError(
            f"{path}: no such results file; lerobot-eval writes it with --env.results_path={path}"
        )
    rows, damages = [], []
    for number, line in enumerate(path.read_bytes().split(b"\n"), start=1):
        if not line.strip():
            continue
        try:
            rows.append(parse_line(line))
        except (ValueError, RecursionError) as error:
            damages.append(f"{path}:{number}: not an episode result: {error}")
    return rows, damages


def parse_line(line: bytes) -> Row:
    """An episode's fields.

    Raises:
        ValueError: the line is not JSON, or a field is missing, mistyped or impossible.
    """
    try:
        row = json.loads(line)
    except json.JSONDecodeError as error:
        raise ValueError(f"{error.msg} at column {error.colno}") from None
    if not isinstance(row, dict):
        raise ValueError("no JSON object")
    version = row.get("protocol_version")
    if version not in VERSIONS:
        raise ValueError(f"protocol_version {version!r}; this package reads {', '.join(VERSIONS)}")
    is_pusht = version == PUSHT_PROTOCOL_VERSION
    check_fields(row, PUSHT_CHECKS if is_pusht else CHECKS if version == OLD_VERSION else CHECKS | NEW_CHECKS)
    if row.get("policy") is not None:
        check_fields(row["policy"], POLICY_CHECKS, "policy.")
    if row["is_success"] != (row["failure"] is None):
        raise ValueError(f"is_success={row['is_success']} with failure={row['failure']!r}")
    if is_pusht:
        check_pusht_spec(row["spec"])
        return row
    _check_spec(row["spec"])
    for name in ("target", "color"):
        if row["spec"][name] not in (None, row[name]):
            raise ValueError(f"{name}={row[name]}, but spec.{name}={row['spec'][name]}")
    return row


def _check_spec(spec: dict[str, Any]) -> None:
    check_fields(spec, SPEC_CHECKS, "spec.")
    refuse_others(spec, SPEC_CHECKS)
    values: dict[str, Any] = spec | {"target": spec["target"] and tuple(spec["target"])}
    EpisodeSpec(**values)
