"""Cells shared by several sections."""

from collections.abc import Callable

from lerobot_bomb.explain.aggregate import Mean
from lerobot_bomb.report.table import Cell
from lerobot_bomb.results.groups import rate_of
from lerobot_bomb.results.pairs import PairedComparison
from lerobot_bomb.results.record import Record
from lerobot_bomb.stats import format_bounds, format_p, points_format

INTERVALS = "95 % Wilson intervals, clustered by seed"  # of `rate`
PAIRED_INTERVAL = "Newcombe's 95 % interval for pairs, clustered by seed"  # of `points`


def rate[R: Record](
    records: list[R], is_counted: Callable[[R], bool] = lambda record: record.is_success
) -> Cell:
    """Return the cell '96 % [87, 99]' of records; '-' of none."""
    if not records:
        return Cell("-")
    found = rate_of(records, is_counted)
    low, high = found.interval or (None, None)
    value = {"successes": found.successes, "n": found.n, "low": low, "high": high}
    return Cell(found.whole_percent, value, found.share)


def points(compared: PairedComparison) -> list[Cell]:
    """Return the cells '-12 [-20, -5]', second rate minus first in percentage points, and p-value."""
    counts, (low, high) = compared.counts, compared.interval or (None, None)
    value = {"difference": counts.difference, "low": low, "high": high, **vars(counts)}
    form = f"+{points_format(counts.difference)}"
    text = f"{100 * counts.difference:{form}}{format_bounds(compared.interval, form, 100)}"
    return [Cell(text, value), Cell(format_p(compared.p_value).removeprefix("p = "), compared.p_value)]


def mean_cell(mean: Mean | None, form: str, shade: float | None = None) -> Cell:
    """Return the cell '0.12 [0.10, 0.15]' in a format; '-' without a mean."""
    if mean is None:
        return Cell("-")
    text = f"{mean.value:{form}}{format_bounds(mean.interval, form)}"
    return Cell(text, {"value": mean.value, "interval": mean.interval}, shade)


def count(number: int, total: int) -> Cell:
    """Return the cell of a number, coloured by its share; empty for 0."""
    return Cell(str(number) if number else "", number, number / total if total else 0.0)
