"""Cells that several sections have."""

from collections.abc import Callable

from lerobot_bomb.envs.results import Row
from lerobot_bomb.report.table import Cell
from lerobot_bomb.stats import PairedCounts, paired_difference_interval, wilson_interval


def rate(rows: list[Row], is_counted: Callable[[Row], bool] = lambda row: row["is_success"]) -> Cell:
    """'96 % [87, 99]' of rows; '-' of none."""
    if not rows:
        return Cell("-")
    number = sum(map(is_counted, rows))
    share, (low, high) = number / len(rows), wilson_interval(number, len(rows))
    text = f"{100 * share:.0f} % [{100 * low:.0f}, {100 * high:.0f}]"
    return Cell(text, {"successes": number, "n": len(rows), "low": low, "high": high}, share)


def points(counts: PairedCounts, p_value: float) -> list[Cell]:
    """'-12 [-20, -5]' per cent, the second rate minus the first; and its p-value."""
    low, high = paired_difference_interval(counts)
    value = {"difference": counts.difference, "low": low, "high": high, **vars(counts)}
    text = f"{100 * counts.difference:+.0f} [{100 * low:+.0f}, {100 * high:+.0f}]"
    return [Cell(text, value), Cell(f"{p_value:.2g}", p_value)]


def count(number: int, of: int) -> Cell:
    """A number, coloured by its share; nothing of 0."""
    return Cell(str(number) if number else "", number, number / of if of else 0.0)
