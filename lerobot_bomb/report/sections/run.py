"""Section `run`: the evaluations, and the flags that repeat them."""

import shlex

from lerobot_bomb.report.report import Report
from lerobot_bomb.report.table import Section
from lerobot_bomb.results.groups import Group, by_condition, by_task
from lerobot_bomb.results.record import Record


def section(report: Report) -> Section:
    """Write the section: lines of each group."""
    lines = [line for group in report.groups for line in (group.name, *commands(group))]
    return Section("What was run", [], lines, is_folded=True)


def commands(group: Group) -> list[str]:
    """Describe the evaluations, and the flags that repeat them."""
    by, first = by_condition(group.records), group.records[0]
    seeds = {each.spec.seed for each in group.records}
    most = max(len(episodes) for records in by.values() for episodes in by_task(records).values())
    flags = ["--policy.type=TYPE" if first.policy is None else first.policy.flag]
    flags += [*first.eval_flags(group.records), *first.condition_flags(by), *_as_evaluated(first)]
    flags += [f"--seed={min(seeds)}", f"--eval.n_episodes={most}"]
    return [*(f"  {line}" for line in group.lines()), f"  {shlex.join(['lerobot-eval', *flags])}"]


def _as_evaluated(record: Record) -> list[str]:
    """Return flags of device and batch, on which outcomes may depend, as far as the record says."""
    device = "" if record.inference is None else record.inference.device
    batch_size = None if record.policy is None else record.policy.batch_size
    flags = ["--policy.device=cpu"] if device.startswith("cpu") else []
    return flags + ([f"--eval.batch_size={batch_size}", "--eval.use_async_envs=false"] if batch_size else [])
