"""The episode results that ``--env.results_path`` collects, read and summarised."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from lerobot_bomb.conditions import NONE
from lerobot_bomb.envs.results import Row
from lerobot_bomb.evaluation import efficiency
from lerobot_bomb.evaluation.paired import PairedComparison, compare_pairs, describe_test
from lerobot_bomb.evaluation.result_groups import (
    Group,
    differing,
    groups_of,
    pair_with_nominal,
    rate_of,
)
from lerobot_bomb.evaluation.result_kind import NO_VALUE, Measure
from lerobot_bomb.evaluation.result_lines import check_any, kind_of, read_lines
from lerobot_bomb.stats import Rate, format_p


@dataclass(frozen=True)
class Summary:
    """Summary of episodes of one environment."""

    rate: Rate
    measures: dict[Measure, str]  # and their values
    failures: Counter[str]
    efficiency: list[tuple[str, str, str]]  # name, value and note of what was measured

    def lines(self) -> list[str]:
        """The summary as text, a line each."""
        figures = [("success", str(self.rate), self.rate.method)]
        figures += [
            (measure.name, value, measure.note)
            for measure, value in self.measures.items()
            if value != NO_VALUE
        ]
        figures += [("failures", named_counts(self.failures), ""), *self.efficiency]
        return [f"{name:<16} {value}{f' ({note})' if note else ''}" for name, value, note in figures]


def named_counts(counts: Counter[str]) -> str:
    """'dropped 3, imprecise 1', the most frequent first."""
    return ", ".join(f"{name} {count}" for name, count in counts.most_common()) or "none"


def read_results(path: Path) -> list[Row]:
    """The rows of a results file; of an episode that was run again, the last one.

    Raises:
        ValueError: the file is missing or empty, or a line is damaged.
    """
    rows, damages = read_lines(path)
    if damages:
        raise ValueError(damages[0])
    check_any(path, rows, damages)
    return [row for group in groups_of([*rows.values()]) for row in group.rows]


def summarise(rows: list[Row]) -> Summary:
    """Summarise episodes of one environment."""
    return Summary(
        rate=rate_of(rows),
        measures={measure: measure.value(rows) for measure in kind_of(rows[0]).measures},
        failures=Counter(row["failure"] for row in rows if not row["is_success"]),
        efficiency=efficiency.lines(rows),
    )


def _pair_line(of: PairedComparison) -> str:
    counts, change = of.counts, of.describe_change()
    return (
        f"  {of.condition}: {counts.n} pairs, {counts.only_first} lost, {counts.only_second} won, "
        f"{format_p(of.p_value)} ({describe_test(of.num_conditions)}){'; ' * bool(change)}{change}"
    )


def pair_lines(group: Group, groups: list[Group]) -> list[str]:
    """Describe how perturbations changed a group's successes, or why there is nothing to compare with."""
    perturbed = [row for row in group.rows if row["spec"]["perturbations"] != NONE]
    pairs = pair_with_nominal(group.rows)
    lines = list(map(_pair_line, compare_pairs(pairs)))
    paired = {id(row) for of in pairs.values() for _, row in of}
    left = [row for row in perturbed if id(row) not in paired]
    if not left:
        return lines
    advice = 'add "none" to --env.perturbations'
    others = [
        other
        for other in groups
        if pair_with_nominal([row for row in other.rows if row["spec"]["perturbations"] == NONE] + left)
    ]
    if others:
        advice = f"those of this file differ in {', '.join(differing([group, others[0]]))}"
    return [*lines, f"  perturbed episodes without an unperturbed one to compare with: {len(left)}; {advice}"]
