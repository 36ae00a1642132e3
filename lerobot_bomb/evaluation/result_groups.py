"""Episodes that compare: which lines of a results file may be pooled and paired, and what they are of."""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from lerobot_bomb.bomb.board import task_id
from lerobot_bomb.conditions import NONE
from lerobot_bomb.evaluation.pusht_lines import is_of_pusht, simulator_of
from lerobot_bomb.evaluation.result_lines import NEW_CHECKS, OLD_VERSION, Row

# what may differ between episodes that are pooled; perturbations between those that are paired
DRAWN = ("seed", "target", "color", "perturbations")
NOT_RECORDED = "not recorded"
SHOWN_DIGITS = 12  # of a SHA-256
MAX_RUNS = 10  # of numbers, in a heading
# what does not keep episodes apart
LISTED = {
    "lerobot_bomb": "package_version",
    "LeRobot": "lerobot_version",
    "torch": "torch_version",
    "machine": "machine",
}


@dataclass(frozen=True)
class Group:
    """Episodes of one policy under one set of settings, each once."""

    settings: dict[str, str]  # what other groups may differ in
    rows: list[Row]
    num_replaced: int  # lines of episodes that were run again

    @property
    def is_of_old_version(self) -> bool:
        return self.rows[0]["protocol_version"] == OLD_VERSION

    def lines(self) -> list[str]:
        """What was evaluated, a line each: who and what, on which machine, with what."""
        first, spec = self.rows[0], dict(self.rows[0]["spec"])
        asked = [f"{name}={spec[name]}" for name in spec if name not in DRAWN]
        conditions = {row["spec"]["perturbations"] for row in self.rows}
        asked += [f"perturbations={conditions.pop()}"] if len(conditions) == 1 else []
        seeds = _ranges(row["spec"]["seed"] for row in self.rows)
        if is_of_pusht(first):
            simulator = f"{first['image_size']} px, {self.settings['simulator']}"
        else:
            simulator = (
                f"{first['image_size']} px, render_preset {self.settings['render_preset']}, "
                f"OpenGL {self.settings['OpenGL']}, MuJoCo {self.settings['MuJoCo']}"
            )
        return [
            f"policy {describe_policy(first)}; {describe_tasks(self.rows)}",
            f"protocol {first['protocol_version']}, {', '.join(asked)}, seeds {seeds}",
            f"{simulator}, " + ", ".join(f"{name} {self._values(key)}" for name, key in LISTED.items()),
        ]

    def _values(self, key: str) -> str:
        return " and ".join(sorted({row.get(key) or NOT_RECORDED for row in self.rows}))


def groups_of(rows: list[Row]) -> list[Group]:
    """Lines apart that must not be pooled or paired; of an episode that was run again, the last one."""
    settings: dict[str, dict[str, str]] = {}
    episodes: dict[str, dict[str, Row]] = {}
    counts: dict[str, int] = {}
    for row in rows:
        of_row = settings_of(row)
        key = json.dumps(of_row)
        settings.setdefault(key, of_row)
        episodes.setdefault(key, {})[json.dumps(row["spec"], sort_keys=True)] = row
        counts[key] = counts.get(key, 0) + 1
    return [Group(settings[key], list(of.values()), counts[key] - len(of)) for key, of in episodes.items()]


def settings_of(row: Row) -> dict[str, str]:
    """All that must be equal in episodes that are pooled or paired."""
    spec = {name: str(value) for name, value in sorted(row["spec"].items()) if name not in DRAWN}
    shared = {
        "policy": _policy_key(row),
        "protocol": row["protocol_version"],
        "image_size": str(row["image_size"]),
    }
    if is_of_pusht(row):
        return {**shared, "simulator": simulator_of(row), **spec}
    opengl = [name for name in (row.get("opengl_vendor"), row.get("opengl_renderer")) if name]
    return {
        **shared,
        "MuJoCo": row.get("mujoco_version") or NOT_RECORDED,
        "OpenGL": ", ".join(opengl) or NOT_RECORDED,
        "render_preset": row.get("render_preset", NOT_RECORDED),
        "tasks": _tasks_key(row),
        **spec,
    }


def differing(groups: list[Group]) -> list[str]:
    """Names of the settings that are not the same in all groups."""
    names = {name: None for group in groups for name in group.settings}
    return [name for name in names if len({group.settings.get(name) for group in groups}) > 1]


def by_condition(rows: list[Row]) -> dict[str, list[Row]]:
    """A group's rows by their perturbations."""
    conditions: dict[str, list[Row]] = {}
    for row in rows:
        conditions.setdefault(row["spec"]["perturbations"], []).append(row)
    return conditions


def pair_with_nominal(rows: list[Row]) -> dict[str, list[tuple[Row, Row]]]:
    """{condition: (unperturbed, perturbed) rows of the same episode} of a group, where there are both."""
    nominal = {_episode(row): row for row in rows if row["spec"]["perturbations"] == NONE}
    pairs: dict[str, list[tuple[Row, Row]]] = {}
    for row in rows:
        condition = row["spec"]["perturbations"]
        if condition != NONE and _episode(row) in nominal:
            pairs.setdefault(condition, []).append((nominal[_episode(row)], row))
    return pairs


def what_old_lines_lack() -> str:
    """Names of the fields that lines of protocol 1.0 do not have."""
    return ", ".join(NEW_CHECKS)


def describe_policy(row: Row) -> str:
    """'act outputs/act (weights 0123456789ab, settings 0123456789ab)', 'act', 'not recorded'."""
    policy = row.get("policy")
    if policy is None:
        return NOT_RECORDED
    revision = f"@{policy['revision']}" if policy["revision"] else ""
    sums = [
        f"{name} {policy[f'{name}_sha256'][:SHOWN_DIGITS]}"
        for name in ("weights", "settings")
        if policy[f"{name}_sha256"]
    ]
    notes = [*sums, *([f"adapters of {policy['base']}"] if policy["base"] else [])]
    notes += ["in training"] if policy["is_in_training"] else []
    words = [policy["type"], *([f"{policy['path']}{revision}"] if policy["path"] else [])]
    return " ".join([*words, *([f"({', '.join(notes)})"] if notes else [])])


def describe_tasks(rows: list[Row]) -> str:
    """What was asked for: 'tasks 0, 12', or target and colour, each fixed or drawn."""
    first = rows[0]
    if is_of_pusht(first):
        return "task pusht"
    if first.get("task_ids") is not None:
        return f"tasks {_ranges(first['task_ids'])}"
    target, color = (first["spec"][name] for name in ("target", "color"))
    if target and color:
        return f"tasks {_ranges({task_id(row['target'], row['color']) for row in rows})}"
    target = "drawn" if target is None else f"row {target[0]}, column {target[1]}"
    return f"target {target}; colour {color or 'drawn'}"


def _policy_key(row: Row) -> str:
    """Equal for the same weights with the same settings, wherever they lie."""
    policy: dict[str, Any] | None = row.get("policy")
    if policy is None:
        return NOT_RECORDED
    names = ["type", "weights_sha256", "settings_sha256", "base", "is_in_training"]
    if policy["weights_sha256"] is None:
        names += ["path", "revision"]
    return json.dumps([policy[name] for name in names])


def _tasks_key(row: Row) -> str:
    if row.get("task_ids") is not None:
        return json.dumps(sorted(row["task_ids"]))
    target, color = (row["spec"][name] for name in ("target", "color"))
    if row["protocol_version"] == OLD_VERSION and target and color:
        return "fixed"  # lines of one evaluation of numbered tasks do not tell those of the others
    return json.dumps([target, color])


def _ranges(numbers: Iterable[int]) -> str:
    """{0, 1, 2, 7} -> '0..2, 7'; of many runs, the first and the last number."""
    runs: list[list[int]] = []
    for number in sorted(set(numbers)):
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    if len(runs) > MAX_RUNS:
        return f"{runs[0][0]}..{runs[-1][-1]}, with gaps"
    return ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]}..{run[-1]}" for run in runs)


def _episode(row: Row) -> str:
    """What a row's spec is but for its perturbations."""
    spec = {name: value for name, value in row["spec"].items() if name != "perturbations"}
    return json.dumps(spec, sort_keys=True)
