"""Section `run`: what was run, and the flags that do it again."""

import json
import shlex

from lerobot_bomb.envs.results import Row
from lerobot_bomb.evaluation.result_groups import by_condition
from lerobot_bomb.report.arms import Arm, Report
from lerobot_bomb.report.table import Section


def section(report: Report) -> Section:
    """Lines of each arm."""
    return Section("What was run", [], [line for arm in report.arms for line in (arm.name, *commands(arm))])


def commands(arm: Arm) -> list[str]:
    """Describe what was evaluated, and the flags that do it again."""
    by = by_condition(arm.rows)
    policy = arm.rows[0].get("policy") or {"type": "TYPE", "path": None}
    who = f"--policy.type={policy['type']}" if policy["path"] is None else f"--policy.path={policy['path']}"
    seeds = {row["spec"]["seed"] for row in arm.rows}
    flags = [who, *arm.group.kind.eval_flags(arm.rows)]
    flags += [f"--env.perturbations={json.dumps(list(by))}"] if arm.group.kind.condition.axes else []
    flags += _as_played(arm.rows[0])
    flags += [f"--seed={min(seeds)}", f"--eval.n_episodes={max(map(len, by.values()))}"]
    return [*(f"  {line}" for line in arm.group.lines()), f"  {shlex.join(['lerobot-eval', *flags])}"]


def _as_played(row: Row) -> list[str]:
    """Device and batch, which outcomes may depend on, as far as the record says."""
    device, batch_size = (
        (row.get("inference") or {}).get("device", ""),
        (row.get("policy") or {}).get("batch_size"),
    )
    flags = ["--policy.device=cpu"] if device.startswith("cpu") else []
    return flags + ([f"--eval.batch_size={batch_size}", "--eval.use_async_envs=false"] if batch_size else [])
