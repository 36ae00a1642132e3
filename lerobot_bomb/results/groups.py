"""Groups of records that may be pooled and paired."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload

from lerobot_bomb.bomb.environment import numbered_task
from lerobot_bomb.conditions import NONE, AxisCondition
from lerobot_bomb.results.names import numbered, policy_key, policy_names
from lerobot_bomb.results.origin import NOT_RECORDED
from lerobot_bomb.results.reading import check_any, read_records
from lerobot_bomb.results.record import Record, describe_numbers
from lerobot_bomb.stats import Rate

POLICY = "policy"  # the one setting that the episodes of two policies may differ in
PER_TASK = ("suite", "task_version")  # settings in which the tasks of one evaluation may differ
# fields of a spec in which a group's episodes may differ: pooled ones in seed, paired ones in perturbations
DRAWN = ("seed", "perturbations")
# fields that a group lists, but that keep no episodes apart
LISTED = {
    "lerobot_bomb": "package_version",
    "LeRobot": "lerobot_version",
    "torch": "torch_version",
    "machine": "machine",
}


@dataclass(frozen=True)
class Group:
    """Episodes of one policy under one set of settings, each once."""

    name: str  # unique among the groups beside it: 'act, place'
    policy: str  # short name of the policy, unique among the policies beside it
    settings: dict[str, str]  # what other groups may differ in
    records: list[Record]
    num_replaced: int  # records of episodes that were run again

    @property
    def record_type(self) -> type[Record]:
        return type(self.records[0])

    @property
    def nominal(self) -> list[Record]:
        """Records of unperturbed episodes."""
        return [each for each in self.records if each.spec.perturbations == NONE]

    @property
    def perturbed(self) -> list[Record]:
        return [each for each in self.records if each.spec.perturbations != NONE]

    @property
    def replaced(self) -> str:
        """Sentence on the records of episodes that were run again; '' if there are none."""
        number = self.num_replaced
        return f"{number} records are replaced by later ones of the same episode" if number else ""

    @property
    def missing_fields(self) -> tuple[str, ...]:
        """Fields of the newest protocol that the group's records do not have."""
        return self.record_type.versions[self.records[0].protocol_version]

    def lines(self) -> list[str]:
        """Describe the evaluation in lines: policy, task, machine, versions."""
        first = self.records[0]
        asked = [f"{name}={value}" for name, value in _fixed(first).items()]
        conditions = {each.spec.perturbations for each in self.records}
        asked += [f"perturbations={conditions.pop()}"] if len(conditions) == 1 else []
        seeds = describe_numbers(each.spec.seed for each in self.records)
        simulator = f"{first.image_size} px, {first.describe_simulator(self.settings)}"
        return [
            f"policy {first.describe_policy()}; {first.describe_tasks(self.records)}",
            f"protocol {first.protocol_version}, {', '.join(asked)}, seeds {seeds}",
            f"{simulator}, " + ", ".join(f"{name} {self._values(key)}" for name, key in LISTED.items()),
        ]

    def _values(self, key: str) -> str:
        return " and ".join(sorted({getattr(each, key) or NOT_RECORDED for each in self.records}))


def suite_or_task(record: Record) -> str:
    """Return the suite of an episode, or its task where the environment has no suites."""
    return getattr(record.spec, "suite", None) or record.tasks[0]


def condition_key(record: Record, condition: AxisCondition) -> str:
    """Name a record's suite under a condition, as `place.camera-3`."""
    return f"{suite_or_task(record)}.{condition.key}"


@dataclass(frozen=True)
class Policy:
    """Groups of one policy, with a short name that is unique among the policies beside it."""

    short_name: str
    groups: list[Group]

    @property
    def name(self) -> str:
        """Name of the group if there is only one; it includes the suite."""
        return self.groups[0].name if len(self.groups) == 1 else self.short_name

    @property
    def records(self) -> list[Record]:
        return [each for group in self.groups for each in group.records]


@overload
def read_results(path: Path) -> list[Record]: ...
@overload
def read_results[R: Record](path: Path, record_type: type[R]) -> list[R]: ...
def read_results(path: Path, record_type: type[Record] = Record) -> Sequence[Record]:
    """Read the records of a results file; of an episode that was run again, only the last.

    Raises:
        ValueError: the file is missing or empty, a line is damaged, or a record is not a ``record_type``.
    """
    records, damages = read_records(path)
    if damages:
        raise ValueError(damages[0])
    check_any(path, records, damages)
    for number, record in records.items():
        if not isinstance(record, record_type):
            raise ValueError(
                f"{path}:{number} is of --env.type={record.env_type}, not of {record_type.env_type}"
            )
    return [each for group in groups_of(records.values()) for each in group.records]


def groups_of(records: Iterable[Record], names: Mapping[str, str] | None = None) -> list[Group]:
    """Split records into groups to pool and pair; of an episode that was run again, keep the last record.

    `names`: {key of a policy: its name}; the others get the shortest that tell them apart.
    """
    by_settings: dict[tuple[tuple[str, str], ...], list[Record]] = {}
    for record in records:
        by_settings.setdefault(tuple(settings_of(record).items()), []).append(record)
    kept = [[*{each.spec: each for each in several}.values()] for several in by_settings.values()]
    by_key = {policy_key(first.policy): first.policy for first, *_ in kept}
    name_of = dict(zip(by_key, policy_names([*by_key.values()], names), strict=True))
    policies = [name_of[policy_key(first.policy)] for first, *_ in kept]
    group_names = [
        f"{policy}, {suite}" if (suite := getattr(first.spec, "suite", None)) else policy
        for policy, (first, *_) in zip(policies, kept, strict=True)
    ]
    return [
        Group(name, policy, dict(settings), last, len(several) - len(last))
        for name, policy, (settings, several), last in zip(
            numbered(group_names), policies, by_settings.items(), kept, strict=True
        )
    ]


def policies_of(groups: Iterable[Group]) -> list[Policy]:
    """Return the policies of groups that were made together."""
    by_key: dict[str, list[Group]] = {}
    for group in groups:
        by_key.setdefault(group.settings[POLICY], []).append(group)
    return [Policy(each[0].policy, each) for each in by_key.values()]


def settings_of(record: Record) -> dict[str, str]:
    """Return the settings that must be equal in episodes that are pooled or paired."""
    return {
        POLICY: policy_key(record.policy),
        "protocol": record.protocol_version,
        "image_size": str(record.image_size),
        **record.settings(),
        **{name: str(value) for name, value in sorted(_fixed(record).items())},
    }


def differing(groups: list[Group]) -> list[str]:
    """Return the settings that are not the same in all groups."""
    names = {name: None for group in groups for name in group.settings}
    return [name for name in names if len({group.settings.get(name) for group in groups}) > 1]


def suite_of(group: Group) -> str:
    """Return the suite of a group's episodes; of an environment without suites, its name."""
    return group.settings.get("suite", group.record_type.env_type)


def differing_otherwise(groups: Iterable[Group]) -> list[str]:
    """Return the settings in which groups of one policy and suite differ."""
    alike: dict[tuple[str, str], list[Group]] = {}
    for group in groups:
        alike.setdefault((group.settings[POLICY], suite_of(group)), []).append(group)
    return [*{name: None for several in alike.values() for name in differing(several)}]


def by_condition[R: Record](records: Iterable[R]) -> dict[AxisCondition, list[R]]:
    """Split a group's records by their perturbations."""
    conditions: dict[AxisCondition, list[R]] = {}
    for record in records:
        conditions.setdefault(record.spec.condition, []).append(record)
    return conditions


def by_task[R: Record](records: Iterable[R]) -> dict[int | None, list[R]]:
    """Split records by the number of their task; None: each episode draws its own, or there is but one."""
    tasks: dict[int | None, list[R]] = {}
    for record in records:
        tasks.setdefault(numbered_task(vars(record.spec)), []).append(record)
    return tasks


def rate_of[R: Record](
    records: list[R], is_counted: Callable[[R], bool] = lambda record: record.is_success
) -> Rate:
    """Return the rate of successes, or of another property, of one or more records, clustered by start."""
    return Rate.of(list(map(is_counted, records)), [each.start_key for each in records])


def _fixed(record: Record) -> dict[str, Any]:
    """Return the fields that a record's spec fixes for all episodes that it is pooled with."""
    drawn = (*DRAWN, *record.drawn)
    return {name: value for name, value in vars(record.spec).items() if name not in drawn}
