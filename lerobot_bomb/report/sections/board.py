"""Section `board`: where on the board stones should go, and where they lie."""

from collections import Counter
from collections.abc import Callable, Iterable

from lerobot_bomb.report.cells import count, rate
from lerobot_bomb.report.report import Report
from lerobot_bomb.report.table import Cell, Section, Table
from lerobot_bomb.results.bomb import EpisodeResult, is_grounded, put_down
from lerobot_bomb.results.groups import Group


def section(report: Report) -> Section:
    """Write the section: up to two tables for each group."""
    return Section("The board", [table for group in report.groups for table in boards(group)])


def boards(group: Group) -> Iterable[Table]:
    """Yield tables of success by intersection, and of misplaced stones, for episodes with one target."""
    records = [each for each in group.records if isinstance(each, EpisodeResult)]
    targets = [each.target for each in records if each.target is not None]
    if not targets:
        return
    records = [each for each in records if each.target is not None]
    size = 1 + max(map(max, (*targets, *(each.nearest_intersection for each in records))))
    header = ["row", *(f"column {column}" for column in range(size))]

    def board(title: str, cell: Callable[[tuple[int, int]], Cell]) -> Table:
        table = [[Cell(str(row)), *(cell((row, column)) for column in range(size))] for row in range(size)]
        return Table(f"{group.name}: {title}", header, table)

    by_target: dict[tuple[int, int], list[EpisodeResult]] = {}
    for target, record in zip(targets, records, strict=True):
        by_target.setdefault(target, []).append(record)
    yield board("success by intersection that was named", lambda at: rate(by_target.get(at, [])))
    missed = Counter(each.nearest_intersection for each in put_down(records) if not is_grounded(each))
    if missed:
        most = max(missed.values())
        yield board("where stones lie that were put down elsewhere", lambda at: count(missed[at], most))
