"""Arms of a report: the episodes of one policy under one set of settings."""

import shlex
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

from lerobot_bomb.conditions import NONE
from lerobot_bomb.envs.results import Row
from lerobot_bomb.evaluation.comparison import POLICY
from lerobot_bomb.evaluation.result_groups import Group, by_condition, groups_of

SHOWN_DIGITS = 6  # of a SHA-256, where names are the same otherwise


@dataclass(frozen=True)
class Arm:
    """Episodes of one policy under one set of settings, with a short name."""

    name: str
    group: Group

    @property
    def rows(self) -> list[Row]:
        return self.group.rows

    @property
    def nominal(self) -> list[Row]:
        """The unperturbed episodes."""
        return by_condition(self.rows).get(NONE, [])


@dataclass(frozen=True)
class Policy:
    """The arms of one policy, with a short name."""

    short_name: str
    arms: list[Arm]

    @property
    def name(self) -> str:
        """Name of its arm, where it has only one: it says the suite, too."""
        return self.arms[0].name if len(self.arms) == 1 else self.short_name

    @property
    def rows(self) -> list[Row]:
        return [row for arm in self.arms for row in arm.rows]


@dataclass(frozen=True)
class Sample:
    """A failed episode that is shown."""

    arm: str
    row: Row
    path: Path  # of its file
    line: int  # of the file, from 1 on
    video: str | None = None  # link from the page
    note: str = ""  # why there is none, or what is to be known of it

    @property
    def command(self) -> str:
        """Command that runs it again."""
        return shlex.join(["lerobot-bomb", "replay", str(self.path), f"--line={self.line}"])

    @property
    def explanation(self) -> str:
        """Command that asks why; '' where no checkpoint acted."""
        if not (self.row.get("policy") or {}).get("path"):
            return ""
        return shlex.join(["lerobot-bomb", "explain", f"--results={self.path}", f"--line={self.line}"])


@dataclass(frozen=True)
class Report:
    """Arms, samples and gaps that the sections are made from."""

    arms: list[Arm]
    samples: list[Sample] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)  # what files lack, or have damaged


def sample_failures(
    arms: list[Arm], files: Mapping[Path, Mapping[int, Row]], num_of_class: int
) -> Iterator[Sample]:
    """Sample at most so many episodes of each arm and class of failure; the same files give the same ones.

    `files`: by path and line, those that the arms' rows are from.
    """
    places = {id(row): (path, line) for path, rows in files.items() for line, row in rows.items()}
    for arm in arms:
        classes = Counter(row["failure"] for row in arm.rows if row["failure"] is not None)
        for name, number in classes.most_common():
            failed = [row for row in arm.rows if row["failure"] == name]
            for row in Random(0).sample(failed, min(num_of_class, number)):
                yield Sample(arm.name, row, *places[id(row)])


def arms_of(rows: list[Row]) -> list[Arm]:
    """Split records that must not be pooled into arms, each with a name that no other has."""
    groups = groups_of(rows)
    first = [group.rows[0] for group in groups]
    return list(map(Arm, _told_apart([_name(row) for row in first], first), groups))


def policies_of(arms: list[Arm]) -> list[Policy]:
    """Policies of these arms, each with a name that no other has."""
    of_key: dict[str, list[Arm]] = {}
    for arm in arms:
        of_key.setdefault(arm.group.settings[POLICY], []).append(arm)
    first = [of[0].rows[0] for of in of_key.values()]
    names = _told_apart([policy_name(row) for row in first], first)
    return list(map(Policy, names, of_key.values()))


def _told_apart(names: list[str], rows: list[Row]) -> list[str]:
    """Names with the weights of the rows' policies where they are the same otherwise, then with numbers."""
    doubled = {name for name, number in Counter(names).items() if number > 1}
    long = [
        f"{name} {_weights(row)}".strip() if name in doubled else name
        for name, row in zip(names, rows, strict=True)
    ]
    still = {name for name, number in Counter(long).items() if number > 1}
    numbers = Counter[str]()
    told = []
    for name in long:
        numbers[name] += 1
        told.append(f"{name} ({numbers[name]})" if name in still else name)
    return told


def policy_name(row: Row) -> str:
    """'TYPE'; of a checkpoint with its folder: 'act outputs/act'."""
    policy = row.get("policy") or {"type": "policy not recorded", "path": None}
    path = "" if policy["path"] is None else f" {'/'.join(policy['path'].rstrip('/').split('/')[-2:])}"
    return f"{policy['type']}{path}"


def _name(row: Row) -> str:
    """'act outputs/act, place'."""
    suite = row["spec"].get("suite")
    return policy_name(row) + (f", {suite}" if suite else "")


def _weights(row: Row) -> str:
    return ((row.get("policy") or {}).get("weights_sha256") or "")[:SHOWN_DIGITS]
