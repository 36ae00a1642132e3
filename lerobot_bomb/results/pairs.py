"""Pairs of records of the same episode, by condition: how often does each succeed, and is it chance?"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from lerobot_bomb.conditions import NONE
from lerobot_bomb.results.record import Record
from lerobot_bomb.stats import (
    SIGNIFICANT,
    PairedCounts,
    clustered_difference_interval,
    episodes_to_tell_apart,
    format_bounds,
    holm,
)

type Pair = tuple[Record, Record]  # one episode unperturbed and perturbed, or of two policies


@dataclass(frozen=True)
class PairedComparison:
    """Pairs of one condition, tested as one of several conditions."""

    condition: str
    pairs: list[Pair]
    counts: PairedCounts
    p_value: float  # of the exact McNemar test, adjusted for the number of conditions
    num_conditions: int

    @cached_property
    def interval(self) -> tuple[float, float] | None:
        """95 % interval of the second rate minus the first, clustered by start; None if all share one."""
        differences = [second.is_success - first.is_success for first, second in self.pairs]
        starts = [first.start_key for first, _ in self.pairs]
        return clustered_difference_interval(self.counts, differences, starts)

    @property
    def num_needed(self) -> int | None:
        """Number of pairs for the test to find this difference; None if it did, or never will."""
        if self.is_significant:
            return None
        return episodes_to_tell_apart(self.counts, SIGNIFICANT / self.num_conditions)

    @property
    def num_starts(self) -> int:
        """Number of starts of the pairs, which are fewer than pairs where tasks share seeds."""
        return len({first.start_key for first, _ in self.pairs})

    @property
    def is_clustered(self) -> bool:
        """True if several pairs share a start; the test takes them as independent, the interval does not."""
        return self.num_starts < len(self.pairs)

    @property
    def is_significant(self) -> bool:
        return self.p_value < SIGNIFICANT

    @property
    def is_shown(self) -> bool:
        """True if the test shows a difference, and the interval does too where it alone allows for starts."""
        if not self.is_significant or not self.is_clustered:
            return self.is_significant
        return self.interval is not None and not self.interval[0] <= 0 <= self.interval[1]

    def describe_difference(self, unit: str = "") -> str:
        """Return '+25.0 [+3.8, +46.9]': second rate minus first in percentage points."""
        return f"{100 * self.counts.difference:+.1f}{unit}{format_bounds(self.interval, '+.1f', 100)}"

    def describe_change(self) -> str:
        """Describe how the second records differ, apart from successes; '' if they do not."""
        return type(self.pairs[0][0]).describe_change(self.pairs)


def pair_with_nominal(records: Sequence[Record]) -> dict[str, list[Pair]]:
    """Return {condition: pairs of unperturbed and perturbed record} of a group's episodes with both."""
    nominal = {
        episode_key(each, "perturbations"): each for each in records if each.spec.perturbations == NONE
    }
    pairs: dict[str, list[Pair]] = {}
    for record in records:
        condition = record.spec.perturbations
        if condition != NONE and (unperturbed := nominal.get(episode_key(record, "perturbations"))):
            pairs.setdefault(condition, []).append((unperturbed, record))
    return pairs


def episode_key(record: Record, across: str | None) -> tuple[Any, ...]:
    """Return a key that is equal for records of one episode, whatever this field of its spec."""
    return tuple([value for name, value in vars(record.spec).items() if name != across])


def pairs_of(first: Sequence[Record], second: Sequence[Record]) -> list[Pair]:
    """Pair the records of the episodes that both have, under the same condition."""
    by_spec = {each.spec: each for each in second}
    return [(each, by_spec[each.spec]) for each in first if each.spec in by_spec]


def count_pairs(pairs: Sequence[Pair]) -> PairedCounts:
    """Count the pairs by which of their records are successes."""
    return PairedCounts.of([a.is_success for a, _ in pairs], [b.is_success for _, b in pairs])


def compare_pairs(pairs: Mapping[str, list[Pair]]) -> list[PairedComparison]:
    """Compare the pairs of each condition; the p-values are adjusted as one family (Holm)."""
    (compared,) = compare_family([pairs])
    return compared


def compare_family(suites: Sequence[Mapping[str, list[Pair]]]) -> list[list[PairedComparison]]:
    """Compare the pairs of each condition of several suites; all their p-values are one family (Holm)."""
    counts = [[*map(count_pairs, pairs.values())] for pairs in suites]
    adjusted = holm([each.p_value for of_suite in counts for each in of_suite])
    p_values = iter(adjusted)
    return [
        [
            PairedComparison(condition, condition_pairs, count, next(p_values), len(adjusted))
            for (condition, condition_pairs), count in zip(pairs.items(), of_suite, strict=True)
        ]
        for pairs, of_suite in zip(suites, counts, strict=True)
    ]


def describe_test(compared: Collection[PairedComparison]) -> str:
    """Describe the test of p-values: 'exact McNemar test, adjusted for 11 conditions (Holm)'."""
    numbers = {each.num_conditions for each in compared}
    if numbers == {1}:
        test = "exact McNemar test of one condition, not adjusted"
    else:
        number = f" for {numbers.pop()} conditions" if len(numbers) == 1 else ""
        test = f"exact McNemar test, adjusted{number} (Holm)"
    return f"{test}, which takes pairs of one seed as independent" if are_clustered(compared) else test


def are_clustered(compared: Iterable[PairedComparison]) -> bool:
    """Return True if several pairs of a condition share a start."""
    return any(each.is_clustered for each in compared)
