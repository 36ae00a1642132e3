"""Rows of the same episodes in pairs, by condition: how often which is a success, and is it chance?"""

from collections.abc import Mapping
from dataclasses import dataclass

from lerobot_bomb.evaluation.result_groups import count_pairs, starts_of
from lerobot_bomb.evaluation.result_kind import Pair
from lerobot_bomb.evaluation.result_lines import kind_of
from lerobot_bomb.stats import (
    SIGNIFICANT,
    PairedCounts,
    episodes_to_tell_apart,
    holm,
    paired_difference_interval,
)


@dataclass(frozen=True)
class PairedComparison:
    """The pairs of one condition, tested as one of several conditions."""

    condition: str
    pairs: list[Pair]
    counts: PairedCounts
    p_value: float  # of the exact McNemar test, adjusted for the number of conditions
    num_conditions: int

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the second rate minus the first."""
        return paired_difference_interval(self.counts)

    @property
    def num_needed(self) -> int | None:
        """Number of pairs in which the same test finds such a difference; None: it did, or never does."""
        if self.p_value < SIGNIFICANT:
            return None
        return episodes_to_tell_apart(self.counts, SIGNIFICANT / self.num_conditions)

    @property
    def num_starts(self) -> int:
        """Number of starts of the pairs, which are fewer than pairs where tasks share seeds."""
        return len(set(starts_of([first for first, _ in self.pairs])))

    def describe_change(self) -> str:
        """Describe what the second records have beside other successes; '' where there is nothing to say."""
        describe = kind_of(self.pairs[0][0]).describe_change
        return describe(self.pairs) if describe else ""


def compare_pairs(pairs: Mapping[str, list[Pair]]) -> list[PairedComparison]:
    """Pairs by condition, tested together: the p-values are those of one family (Holm)."""
    counts = {condition: count_pairs(of) for condition, of in pairs.items()}
    adjusted = holm([each.p_value for each in counts.values()])
    return [
        PairedComparison(condition, of, counts[condition], p_value, len(pairs))
        for (condition, of), p_value in zip(pairs.items(), adjusted, strict=True)
    ]


def describe_test(num_conditions: int) -> str:
    """'exact McNemar test, adjusted for 11 conditions (Holm)': what a p-value is of."""
    if num_conditions == 1:
        return "exact McNemar test of one condition, not adjusted"
    return f"exact McNemar test, adjusted for {num_conditions} conditions (Holm)"
