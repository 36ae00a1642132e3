"""Summary of episodes of one environment, and of the changes under perturbations."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from lerobot_bomb.results import efficiency
from lerobot_bomb.results.groups import POLICY, Group, differing, rate_of
from lerobot_bomb.results.measures import Measure
from lerobot_bomb.results.pairs import PairedComparison, compare_family, describe_test, pair_with_nominal
from lerobot_bomb.results.record import Record
from lerobot_bomb.stats import Rate, format_p


@dataclass(frozen=True)
class Summary:
    """Summary of episodes of one environment."""

    rate: Rate
    measures: dict[Measure, str]  # that the episodes have, and their values
    failures: Counter[str]
    efficiency: list[tuple[str, str, str]]  # name, value and note of what was measured

    def lines(self) -> list[str]:
        """Return the summary as lines of text."""
        figures = [("success", str(self.rate), self.rate.method)]
        figures += [(measure.name, value, measure.note) for measure, value in self.measures.items()]
        figures += [("failures", named_counts(self.failures), ""), *self.efficiency]
        return [f"{name:<16} {value}{f' ({note})' if note else ''}" for name, value, note in figures]


def named_counts(counts: Counter[str]) -> str:
    """Format counts as 'dropped 3, imprecise 1', the most frequent first."""
    return ", ".join(f"{name} {count}" for name, count in counts.most_common()) or "none"


def measured(records: list[Record]) -> dict[Measure, str]:
    """Return {measure that the episodes have: its value}."""
    values = {measure: measure.value(records) for measure in records[0].measures}
    return {measure: value for measure, value in values.items() if value is not None}


def summarise(records: list[Record]) -> Summary:
    """Summarise episodes of one environment."""
    return Summary(
        rate=rate_of(records),
        measures=measured(records),
        failures=Counter(each.failure for each in records if each.failure is not None),
        efficiency=efficiency.lines(records),
    )


def _pair_line(compared: PairedComparison) -> str:
    counts, change = compared.counts, compared.describe_change()
    return (
        f"  {compared.condition}: {counts.n} pairs, {counts.only_first} lost, {counts.only_second} won, "
        f"{format_p(compared.p_value)} ({describe_test([compared])})"
        f"{'; ' * bool(change)}{change}"
    )


def changes_of(groups: Sequence[Group]) -> list[list[PairedComparison]]:
    """Compare each group's conditions with its unperturbed episodes.

    The p-values of a policy are adjusted as one family, whatever its groups.
    """
    places: dict[str, list[int]] = {}
    for place, group in enumerate(groups):
        places.setdefault(group.settings[POLICY], []).append(place)
    changes: dict[int, list[PairedComparison]] = {}
    for of_policy in places.values():
        pairs = [pair_with_nominal(groups[place].records) for place in of_policy]
        changes |= zip(of_policy, compare_family(pairs), strict=True)
    return [changes[place] for place in range(len(groups))]


def pair_lines(changes: Sequence[PairedComparison]) -> list[str]:
    """Describe how perturbations changed a group's successes."""
    return list(map(_pair_line, changes))


def describe_unpaired(group: Group, groups: Sequence[Group]) -> str:
    """Say how many perturbed episodes have nothing to compare with, and the way out; '' if all have."""
    pairs = pair_with_nominal(group.records)
    paired = {id(record) for condition_pairs in pairs.values() for _, record in condition_pairs}
    left = [each for each in group.perturbed if id(each) not in paired]
    if not left:
        return ""
    advice = 'add "none" to --env.perturbations'
    others = [other for other in groups if pair_with_nominal([*other.nominal, *left])]
    if others:
        advice = f"those of this file differ in {', '.join(differing([group, others[0]]))}"
    return f"perturbed episodes without an unperturbed one to compare with: {len(left)}; {advice}"
