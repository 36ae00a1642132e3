"""Outcomes that an episode of `bomb` can have: its fields say the same thing several times."""

from lerobot_bomb.bomb.board import BOARD, task_id
from lerobot_bomb.bomb.episode import Failure, Stage
from lerobot_bomb.bomb.judge import COLLATERAL_TOLERANCE_MM, V0_TOLERANCE_MM
from lerobot_bomb.bomb.suite import find_suite
from lerobot_bomb.envs.results import Row
from lerobot_bomb.evaluation.line_checks import refuse_if

ALL_MADE = (None, Failure.DISTURBED_OTHERS)  # failures of episodes whose moves have all been made
HALF_PITCH_MM = 1000 * BOARD.pitch_m / 2
ROUNDING_MM = 1e-6


def check_outcome(row: Row) -> None:
    """Raise a ValueError that names the fields which contradict each other, as the judge knows them."""
    is_made = row["failure"] in ALL_MADE
    refuse_if(is_made != (row["stage"] == Stage.PLACED), row, "stage", "failure")
    refuse_if(
        row["failure"] == Failure.NEVER_REACHED and row["stage"] != Stage.START, row, "stage", "failure"
    )
    refuse_if("progress" in row and is_made != (row.get("progress") == 1), row, "progress", "failure")
    if is_made:
        is_there = row["placement_error_mm"] <= row["spec"]["success_tolerance_mm"]
        refuse_if(not is_there, row, "placement_error_mm", "failure")
        is_disturbed = row["collateral_mm"] > COLLATERAL_TOLERANCE_MM
        refuse_if(is_disturbed != (row["failure"] is not None), row, "collateral_mm", "failure")
    _check_place(row)
    _check_tasks(row)


def _check_place(row: Row) -> None:
    """Check where the stone lies; nothing is known of it unless there is one move to one intersection."""
    if row["target"] is None:
        refuse_if(row["is_success_bomb_v0"], row, "is_success_bomb_v0", "target")
        return
    error_mm, is_nearest = row["placement_error_mm"], row["nearest_intersection"] == row["target"]
    is_far = error_mm > HALF_PITCH_MM - ROUNDING_MM
    refuse_if(not is_nearest and not is_far, row, "placement_error_mm", "nearest_intersection", "target")
    needs_nearest = row["failure"] in (*ALL_MADE, Failure.IMPRECISE) or row["is_success_bomb_v0"]
    refuse_if(needs_nearest and not is_nearest, row, "nearest_intersection", "target", "failure")
    is_wrong = row["failure"] == Failure.WRONG_INTERSECTION
    refuse_if(is_wrong and is_nearest, row, "nearest_intersection", "target", "failure")
    is_v0_far = row["is_success_bomb_v0"] and error_mm > V0_TOLERANCE_MM
    refuse_if(is_v0_far, row, "placement_error_mm", "is_success_bomb_v0")


def _check_tasks(row: Row) -> None:
    """Check the number of the task, which records of earlier releases do not have."""
    if "task_id" not in row:
        return
    spec = row["spec"]
    refuse_if(row["task_id"] >= find_suite(spec["suite"]).num_tasks, row, "task_id")
    asked = spec.get("task_id")
    if asked not in (None, row["task_id"]):
        raise ValueError(f"task_id={row['task_id']}, but spec.task_id={asked}")
    if row["target"] is not None and row["color"] is not None and spec["suite"] == "place":
        is_same = row["task_id"] == task_id(row["target"], row["color"])
        refuse_if(not is_same, row, "task_id", "target", "color")
    if row.get("task_ids") is not None:
        refuse_if(row["task_id"] not in row["task_ids"], row, "task_id", "task_ids")
