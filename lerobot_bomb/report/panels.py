"""Panels of a report: the policies that compare with each other, side by side, and their conditions."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from lerobot_bomb.conditions import NONE, AxisCondition
from lerobot_bomb.results.comparison import can_compare
from lerobot_bomb.results.groups import PER_TASK, POLICY, Group, by_condition, differing, rate_of
from lerobot_bomb.results.names import numbered
from lerobot_bomb.results.pairs import PairedComparison
from lerobot_bomb.results.record import Record
from lerobot_bomb.results.summary import changes_of
from lerobot_bomb.stats import Rate
from lerobot_bomb.tables import shorten, shorten_all

MAX_CONDITIONS = 24  # that a chart can show below each other
MAX_SETTING = 24  # characters of a setting in the name of a panel


@dataclass(frozen=True)
class Series:
    """Episodes of one policy in a panel."""

    place: int  # of the policy in the report, which has its colour
    group: Group
    # changes by condition, against the same episodes unperturbed
    costs: dict[str, PairedComparison]

    @property
    def policy(self) -> str:
        return self.group.policy

    @cached_property
    def records(self) -> dict[AxisCondition, list[Record]]:
        """Records by condition."""
        return by_condition(self.group.records)

    @cached_property
    def rates(self) -> dict[str, Rate]:
        """Rate of success by condition."""
        return {condition: rate_of(records) for condition, records in self.records.items()}

    @cached_property
    def perturbed(self) -> Rate | None:
        """Rate under all perturbed conditions together; None if there are none."""
        records = self.group.perturbed
        return rate_of(records) if records else None

    def change(self, condition: str) -> float | None:
        """Return the change of the rate under a condition; of all episodes if none of them pair."""
        if condition in self.costs:
            return self.costs[condition].counts.difference
        if condition not in self.rates:
            return None
        return self.rates[condition].share - (self.rates[NONE].share if NONE in self.rates else 1.0)


@dataclass(frozen=True)
class Panel:
    """Policies whose episodes differ in nothing else."""

    name: str  # 'place'; '' if there is nothing to tell
    series: list[Series]

    @cached_property
    def short_names(self) -> dict[str, str]:
        """Names of the policies as sentences and tables show them."""
        return shorten_all(each.policy for each in self.series)

    @cached_property
    def conditions(self) -> list[AxisCondition]:
        """Conditions of all policies: unperturbed first, then by the mean change, the largest loss first."""
        found = dict.fromkeys(condition for each in self.series for condition in each.records)

        def key(condition: AxisCondition) -> tuple[bool, float]:
            changes = [change for each in self.series if (change := each.change(condition)) is not None]
            return condition != NONE, sum(changes) / len(changes)

        return sorted(found, key=key)

    @cached_property
    def shown_conditions(self) -> list[AxisCondition]:
        """Conditions that fit in a chart: all, or of each set of axes the highest levels."""
        if len(self.conditions) <= MAX_CONDITIONS:
            return self.conditions
        widest: dict[tuple[str, ...], AxisCondition] = {}
        for condition in self.conditions:
            axes = tuple(axis for axis, _, _ in condition.ranges)
            if axes not in widest or _levels(condition) > _levels(widest[axes]):
                widest[axes] = condition
        kept = set(widest.values())
        return [each for each in self.conditions if each in kept][:MAX_CONDITIONS]

    @property
    def left_out(self) -> str:
        """Sentence on the conditions that charts do not show; '' if they show all."""
        shown, total = len(self.shown_conditions), len(self.conditions)
        if shown == total:
            return ""
        return (
            f"Shown: {shown} of {total:,} conditions, of each set of axes the highest levels, those with the "
            f"largest loss first; the other {total - shown:,} are in the numbers."
        )

    @cached_property
    def shared(self) -> tuple[str, list[list[Record]]]:
        """Kind of the episodes that all policies have, and these records of each policy.

        Unperturbed episodes if they share any, else all that they share; ("", []) if they share none.
        """
        for kind, of_group in (("unperturbed ", lambda each: each.nominal), ("", lambda each: each.records)):
            by_spec = [{record.spec: record for record in of_group(each.group)} for each in self.series]
            specs = [spec for spec in by_spec[0] if all(spec in other for other in by_spec[1:])]
            if specs:
                return kind, [[records[spec] for spec in specs] for records in by_spec]
        return "", []

    @cached_property
    def ranked(self) -> list[Series]:
        """Policies by their rate on the episodes that all of them have; as they came if there are none."""
        _, records = self.shared
        if not records:
            return self.series
        rates = [rate_of(each).share for each in records]
        order = sorted(range(len(rates)), key=lambda place: -rates[place])
        return [self.series[place] for place in order]


def _levels(condition: AxisCondition) -> int:
    return sum(high for _, _, high in condition.ranges)


def series_of(groups: Sequence[Group]) -> list[Series]:
    """Return the groups with the changes under each condition; p-values are adjusted for each policy."""
    places = {name: place for place, name in enumerate(dict.fromkeys(each.policy for each in groups))}
    return [
        Series(places[group.policy], group, {each.condition: each for each in changes})
        for group, changes in zip(groups, changes_of(groups), strict=True)
    ]


def panels_of(groups: Sequence[Group]) -> list[Panel]:
    """Put groups side by side that differ in nothing but their policies."""
    together: list[list[Series]] = []
    for series in series_of(groups):
        for others in together:
            is_new = all(series.policy != other.policy for other in others)
            if is_new and all(can_compare(series.group, other.group) for other in others):
                others.append(series)
                break
        else:
            together.append([series])
    names = _panel_names([each[0].group for each in together])
    return [Panel(name, panel_series) for name, panel_series in zip(names, together, strict=True)]


def _panel_names(groups: list[Group]) -> list[str]:
    """Name panels by their suites, and by the settings that differ between them."""
    tasks = {tuple(map(each.settings.get, PER_TASK)) for each in groups}
    is_told = len(tasks) == len({suite for suite, _ in tasks})  # a suite of one version: its name says it
    told = (POLICY, *(PER_TASK if is_told else PER_TASK[:1]))
    several = [name for name in differing(groups) if name not in told]
    types = {each.record_type.env_type for each in groups}
    names = []
    for group in groups:
        parts = [group.record_type.env_type] if len(types) > 1 else []
        parts += [group.settings["suite"]] if "suite" in group.settings else []
        shown = ((name, group.settings.get(name, "")) for name in several)
        parts += [f"{name} {shorten(value, MAX_SETTING)}" for name, value in shown if value]
        names.append(", ".join(parts))
    return numbered(names)
