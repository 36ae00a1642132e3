"""Episodes as LeRobot's eval_info.json with seeds, for tools that pair the episodes of two policies."""

import json
from collections.abc import Iterable
from typing import Any

from lerobot_bomb.results.groups import Group, by_condition, by_task, condition_key, rate_of
from lerobot_bomb.results.record import Record

EVAL_INFO, RUN_META = "eval_info.json", "run_meta.json"


def eval_info_files(groups: Iterable[Group]) -> dict[str, str]:
    """Return {path: content} of a policy's two files for each suite, condition and numbered task.

    LeRobot's own eval_info.json names no seeds; the layout with seeds is that of its releases before 0.4.
    run_meta.json says what was evaluated, by the names that `arisole evaluate` reads.
    """
    files = {}
    for group in groups:
        for condition, records in by_condition(group.records).items():
            for number, episodes in by_task(records).items():
                task = condition_key(records[0], condition) + ("" if number is None else f".task-{number}")
                files[f"{task}/{EVAL_INFO}"] = _json(_eval_info(episodes))
                files[f"{task}/{RUN_META}"] = _json(_run_meta(task, episodes[0]))
    return files


def _eval_info(records: list[Record]) -> dict[str, Any]:
    episodes = [
        {
            "episode_ix": number,
            "sum_reward": getattr(record, "sum_reward", float(record.is_success)),
            "max_reward": getattr(record, "max_reward", float(record.is_success)),
            "success": record.is_success,
            "seed": record.spec.seed,
        }
        for number, record in enumerate(sorted(records, key=lambda each: each.spec.seed))
    ]
    return {"per_episode": episodes, "aggregated": {"pc_success": 100 * rate_of(records).share}}


def _run_meta(task: str, record: Record) -> dict[str, Any]:
    policy = record.policy
    return {
        "task": task,
        "environment": record.env_type,
        "environment_version": record.benchmark(),
        "embodiment": getattr(record.spec, "robot", None),
        "policy_family": policy and policy.type,
        "checkpoint_id": policy and policy.key,
        "run_kind": "simulation",
    }


def _json(values: dict[str, Any]) -> str:
    return json.dumps(values, indent=1) + "\n"
