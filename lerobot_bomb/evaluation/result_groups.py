"""Episodes that compare: which records of a results file may be pooled and paired, and what they are of."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from lerobot_bomb.conditions import NONE
from lerobot_bomb.envs.results import ORIGIN, Row, without_measured
from lerobot_bomb.evaluation.result_kind import NOT_RECORDED, Pair, ResultKind, describe_numbers, json_list
from lerobot_bomb.evaluation.result_lines import kind_of
from lerobot_bomb.stats import PairedCounts, Rate

# what may differ between episodes that are pooled; perturbations between those that are paired
DRAWN = ("seed", "perturbations")
SHOWN_DIGITS = 12  # of a SHA-256
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
    def kind(self) -> ResultKind:
        return kind_of(self.rows[0])

    @property
    def missing_fields(self) -> list[str]:
        """Fields of the newest protocol that the group's records do not have."""
        return self.kind.missing_fields(self.rows[0]["protocol_version"])

    def lines(self) -> list[str]:
        """Describe what was evaluated, a line each: who and what, on which machine, with what."""
        first, kind = self.rows[0], self.kind
        asked = [f"{name}={value}" for name, value in _fixed(first).items()]
        conditions = {row["spec"]["perturbations"] for row in self.rows}
        asked += [f"perturbations={conditions.pop()}"] if len(conditions) == 1 else []
        seeds = describe_numbers(row["spec"]["seed"] for row in self.rows)
        simulator = f"{first['image_size']} px, {kind.describe_simulator(self.settings)}"
        return [
            f"policy {describe_policy(first)}; {kind.describe_tasks(self.rows)}",
            f"protocol {first['protocol_version']}, {', '.join(asked)}, seeds {seeds}",
            f"{simulator}, " + ", ".join(f"{name} {self._values(key)}" for name, key in LISTED.items()),
        ]

    def _values(self, key: str) -> str:
        return " and ".join(sorted({row.get(key) or NOT_RECORDED for row in self.rows}))


def groups_of(rows: list[Row]) -> list[Group]:
    """Split records that must not be pooled or paired; of an episode that was run again, the last one."""
    episodes: dict[tuple[tuple[str, str], ...], dict[str, Row]] = {}
    counts = Counter[tuple[tuple[str, str], ...]]()
    for row in rows:
        settings = tuple(settings_of(row).items())
        episodes.setdefault(settings, {})[episode_of(row)] = row
        counts[settings] += 1
    return [
        Group(dict(settings), list(of.values()), counts[settings] - len(of))
        for settings, of in episodes.items()
    ]


def episode_of(row: Row) -> str:
    """Return a text that is equal for rows of one episode under one condition, whoever acts."""
    return str(sorted(row["spec"].items()))


def settings_of(row: Row) -> dict[str, str]:
    """Return the settings that must be equal in episodes that are pooled or paired."""
    return {
        "policy": _policy_key(row),
        "protocol": row["protocol_version"],
        "image_size": str(row["image_size"]),
        **kind_of(row).settings(row),
        **{name: str(value) for name, value in sorted(_fixed(row).items())},
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


def pair_with_nominal(rows: list[Row]) -> dict[str, list[Pair]]:
    """{condition: (unperturbed, perturbed) rows of the same episode} of a group, where there are both."""
    nominal = {_episode(row): row for row in rows if row["spec"]["perturbations"] == NONE}
    pairs: dict[str, list[Pair]] = {}
    for row in rows:
        condition = row["spec"]["perturbations"]
        if condition != NONE and _episode(row) in nominal:
            pairs.setdefault(condition, []).append((nominal[_episode(row)], row))
    return pairs


def starts_of(rows: list[Row]) -> list[tuple[Any, ...]]:
    """Start of each row; those of one start, under several conditions or on several tasks, are alike."""
    return [kind_of(row).start_of(row) for row in rows]


def rate_of(rows: list[Row], is_counted: Callable[[Row], bool] = lambda row: row["is_success"]) -> Rate:
    """Rate of success of at least one row, or of something else; rows of one start are one cluster."""
    return Rate.of(list(map(is_counted, rows)), starts_of(rows))


def count_pairs(pairs: list[Pair]) -> PairedCounts:
    """Count the pairs by which of their records are successes."""
    return PairedCounts.of([a["is_success"] for a, _ in pairs], [b["is_success"] for _, b in pairs])


def different_fields(row: Row, other: Row) -> list[str]:
    """Return the names of the fields of `outcome` that differ between two records of one episode."""
    return [name for name, value in outcome(row).items() if value != other.get(name)]


def outcome(row: Row) -> Row:
    """Return what was asked and its outcome: not which policy ran it, where, and how long that took."""
    return {name: value for name, value in without_measured(row).items() if name not in ORIGIN}


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
    notes += [f"with {name}" for name in policy.get("interventions", ())]
    words = [policy["type"], *([f"{policy['path']}{revision}"] if policy["path"] else [])]
    return " ".join([*words, *([f"({', '.join(notes)})"] if notes else [])])


def _fixed(row: Row) -> dict[str, Any]:
    """Return the fields that a record's spec fixes for all episodes that it is pooled with."""
    drawn = (*DRAWN, *kind_of(row).drawn)
    return {name: value for name, value in row["spec"].items() if name not in drawn}


def _policy_key(row: Row) -> str:
    """Return a key that is equal for the same weights with the same settings, wherever they lie."""
    policy: dict[str, Any] | None = row.get("policy")
    if policy is None:
        return NOT_RECORDED
    names = ["type", "weights_sha256", "settings_sha256", "base", "is_in_training"]
    if policy["weights_sha256"] is None:
        names += ["path", "revision"]
    return json_list(*(policy[name] for name in names))


def _episode(row: Row) -> str:
    """Return a text that is equal for rows of one episode under any condition."""
    return str(sorted(item for item in row["spec"].items() if item[0] != "perturbations"))
