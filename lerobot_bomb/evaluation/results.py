"""The episode results that ``--env.results_path`` collects, read and summarised."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from lerobot_bomb.bomb.episode import Failure
from lerobot_bomb.conditions import NONE
from lerobot_bomb.evaluation.pusht_lines import coverage_change, is_of_pusht, pusht_summary
from lerobot_bomb.evaluation.result_groups import (
    Group,
    differing,
    groups_of,
    pair_with_nominal,
)
from lerobot_bomb.evaluation.result_lines import Row, read_lines
from lerobot_bomb.stats import format_rate, mcnemar_p_value

# outcomes of an episode in which the stone was carried and put down somewhere on the board
PUT_DOWN = (None, Failure.WRONG_INTERSECTION, Failure.IMPRECISE, Failure.DISTURBED_OTHERS)


@dataclass(frozen=True)
class Summary:
    """What a results file says: counts over its episodes and errors of the stones that were released."""

    num_episodes: int
    num_successes: int
    median_error_mm: float | None  # over the episodes in which the stone was put down on the board
    failures: Counter[str]

    def lines(self) -> list[str]:
        """The summary as text, a line each."""
        error = "-" if self.median_error_mm is None else f"{self.median_error_mm:.1f} mm"
        failures = ", ".join(f"{name} {count}" for name, count in self.failures.most_common()) or "none"
        return [
            f"success          {format_rate(self.num_successes, self.num_episodes)} (95 % Wilson interval)",
            f"placement error  {error} (median of the stones that were put down)",
            f"failures         {failures}",
        ]


def read_results(path: Path) -> list[Row]:
    """The rows of a results file of `bomb`; of an episode that was run again, the last one.

    Raises:
        ValueError: the file is missing or empty, or a line is damaged or of another environment.
    """
    rows, damages = read_lines(path)
    if damages:
        raise ValueError(damages[0])
    if not rows:
        raise ValueError(f"{path}: no finished episode")
    if any(map(is_of_pusht, rows)):
        raise ValueError(f"{path} has lines of bomb_pusht, which only `lerobot-bomb results` reads")
    return [row for group in groups_of(rows) for row in group.rows]


def summarise(rows: list[Row]) -> Summary:
    """Counts, rates and the median error of episodes."""
    errors = [row["placement_error_mm"] for row in rows if row["failure"] in PUT_DOWN]
    return Summary(
        num_episodes=len(rows),
        num_successes=sum(row["is_success"] for row in rows),
        median_error_mm=median(errors) if errors else None,
        failures=Counter(row["failure"] for row in rows if not row["is_success"]),
    )


def summary_lines(rows: list[Row]) -> list[str]:
    """What episodes of one environment come to, a line each."""
    return pusht_summary(rows) if is_of_pusht(rows[0]) else summarise(rows).lines()


def _pair_line(condition: str, pairs: list[tuple[Row, Row]]) -> str:
    lost = sum(nominal["is_success"] and not row["is_success"] for nominal, row in pairs)
    won = sum(row["is_success"] and not nominal["is_success"] for nominal, row in pairs)
    p_value = mcnemar_p_value(lost, won)
    change = f"; {coverage_change(pairs)}" if is_of_pusht(pairs[0][0]) else ""
    return (
        f"  {condition}: {len(pairs)} pairs, {lost} lost, {won} won, p = {p_value:.2g} (exact McNemar test)"
        f"{change}"
    )


def pair_lines(group: Group, groups: list[Group]) -> list[str]:
    """What perturbations took away and brought in a group; or why there is nothing to compare with."""
    perturbed = [row for row in group.rows if row["spec"]["perturbations"] != NONE]
    pairs = pair_with_nominal(group.rows)
    lines = [_pair_line(condition, of) for condition, of in pairs.items()]
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
