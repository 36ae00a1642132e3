"""Rows of a table of results: success under each condition, and its change from the unperturbed episodes."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from lerobot_bomb.conditions import AxisCondition
from lerobot_bomb.results.groups import POLICY, Group, by_condition, differing, rate_of
from lerobot_bomb.results.pairs import PairedComparison, compare_pairs, pair_with_nominal
from lerobot_bomb.stats import Rate, format_p


@dataclass(frozen=True)
class Row:
    """Success of a group under one condition."""

    group: Group
    condition: AxisCondition
    rate: Rate
    change: PairedComparison | None  # from the same episodes unperturbed; None: there is no pair

    def texts(self) -> list[str]:
        """Return the cells condition, rate, change, p and n."""
        change = self.change
        changed = ["", ""] if change is None else [change.describe_difference(), short_p(change.p_value)]
        return [self.condition, self.rate.percent, *changed, str(self.rate.n)]


def rows_of(group: Group) -> Iterator[Row]:
    """Yield a row for each condition of a group; the p-values are adjusted as one family."""
    changes = {each.condition: each for each in compare_pairs(pair_with_nominal(group.records))}
    for condition, records in by_condition(group.records).items():
        yield Row(group, condition, rate_of(records), changes.get(condition))


def short_p(p_value: float) -> str:
    """Return '0.031', or '< 1e-99'."""
    return format_p(p_value).removeprefix("p ").removeprefix("= ")


def suite_of(group: Group) -> str:
    """Return the suite of a group's episodes; of an environment without suites, its name."""
    return group.settings.get("suite", group.record_type.env_type)


def differing_otherwise(groups: Sequence[Group]) -> list[str]:
    """Return the settings in which groups of one policy and suite differ."""
    alike: dict[tuple[str, str], list[Group]] = {}
    for group in groups:
        alike.setdefault((group.settings[POLICY], suite_of(group)), []).append(group)
    return [*{name: None for several in alike.values() for name in differing(several)}]
