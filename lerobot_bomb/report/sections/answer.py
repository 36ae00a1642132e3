"""Section `answer`: how often each policy succeeds, which is better, and what each condition costs."""

from lerobot_bomb.conditions import NONE, AxisCondition
from lerobot_bomb.report.cells import INTERVALS, PAIRED_INTERVAL, points, rate
from lerobot_bomb.report.chart import MAX_SERIES, Chart
from lerobot_bomb.report.dots import Block, Dot, DotColumn, dot_chart
from lerobot_bomb.report.panels import Panel, Series
from lerobot_bomb.report.report import Report
from lerobot_bomb.report.sentences import describe_comparison, describe_ranking, describe_series
from lerobot_bomb.report.table import MAX_TOLD, Cell, Section, Statement, Table
from lerobot_bomb.results.pairs import PairedComparison, describe_test
from lerobot_bomb.results.summary import measured
from lerobot_bomb.stats import Rate

TITLE = "Success"
RATE_LABEL = "success, per cent"
POINTS_LABEL = "change, percentage points"
NOTE = (
    "A condition such as camera:3 is one perturbation axis at level 3 of 5; all:3 is all axes at once. "
    f"Success: with {INTERVALS}."
)
COST_NOTE = (
    f"Change: from the same episodes unperturbed, with {PAIRED_INTERVAL}; filled where "
    "p < 0.05 by the exact McNemar test, adjusted for the policy's conditions (Holm)."
)
SUMMARY_NOTE = (
    f"Success in per cent, with {INTERVALS}: the conditions of one seed are no independent episodes. Shared: "
    "the unperturbed episodes that all policies have, or all that they have if no unperturbed ones. "
    "Measures: of the unperturbed episodes, if any"
)
MANY_NOTE = f"With {INTERVALS}. The map below has the conditions one by one."


def section(report: Report) -> Section:
    """Write the section: sentences, the figure, and its numbers."""
    statements = [each for panel in report.panels for each in _statements(report, panel)]
    lines = [*report.missing, *(line for panel in report.panels for line in _not_shared(panel))]
    return Section(TITLE, [], lines, statements=statements, charts=[_chart(report)])


def _statements(report: Report, panel: Panel) -> list[Statement]:
    """Say which policy of a panel is better, then what is known of each."""
    told = panel.ranked[:MAX_TOLD]
    found = list(describe_ranking(panel)) if len(panel.series) > 1 else []
    for other in told[1:]:
        first, second = sorted((told[0], other), key=lambda each: each.place)
        compared = report.compared(first.policy, second.policy)
        if compared is not None:
            found.append(describe_comparison(panel, first, second, compared))
    return found + [describe_series(each, panel) for each in told]


def _not_shared(panel: Panel) -> list[str]:
    """Return a line for each policy that has episodes which not all others have."""
    specs = [{each.spec for each in series.group.records} for series in panel.series]
    shared = set.intersection(*specs)
    return [
        f"{series.group.name}: {len(own) - len(shared)} of its {len(own)} episodes were not run by all "
        "policies; pairs and ranking leave them out"
        for series, own in zip(panel.series, specs, strict=True)
        if len(own) > len(shared)
    ]


def _meanings(report: Report) -> list[Table]:
    """Return a table of what each axis that is on changes; none if none is."""
    given = {each.spec.perturbations for group in report.groups for each in group.perturbed}
    summaries = {
        name: condition.axes[name].summary
        for condition in sorted(given)
        if isinstance(condition, AxisCondition)
        for name, *_ in condition.ranges
    }
    rows = [[Cell(name), Cell(summary)] for name, summary in summaries.items()]
    return [Table("What the axes change", ["axis", "changes"], rows)] if rows else []


def _chart(report: Report) -> Chart:
    names = list(report.policies)
    many = max(len(panel.series) for panel in report.panels) > MAX_SERIES
    if many:
        title = "Success by policy, unperturbed and perturbed"
        series, blocks, note = ["unperturbed", "perturbed"], [*map(_policy_block, report.panels)], MANY_NOTE
    else:
        title = "Success by condition, and what each condition costs"
        series, blocks, note = names, [*map(_condition_block, report.panels)], NOTE
    left = dict.fromkeys(panel.left_out for panel in report.panels)
    has_costs = not many and any(each.costs for panel in report.panels for each in panel.series)
    note = " ".join([note, *([COST_NOTE] if has_costs else []), *filter(None, left)])
    tables = [_summary(report), *(conditions(each) for panel in report.panels for each in panel.series)]
    tables += _meanings(report)
    return Chart(title, dot_chart(title, series, blocks), tables, note)


def _condition_block(panel: Panel) -> Block:
    """Return the rows of conditions: success, and the change where a policy has pairs."""
    shown = panel.shown_conditions
    series = panel.series
    rates = {each.place: [_rate_dot(each.rates.get(condition)) for condition in shown] for each in series}
    costs = {each.place: [_cost_dot(each.costs.get(condition)) for condition in shown] for each in series}
    columns = [DotColumn(RATE_LABEL, rates, (-2, 102))]
    if any(each.costs for each in series):
        columns.append(DotColumn(POINTS_LABEL, costs, line=0))
    rows = ["unperturbed" if condition == NONE else str(condition) for condition in shown]
    return Block(panel.name, rows, columns)


def _policy_block(panel: Panel) -> Block:
    """Return the rows of policies, the best first."""
    ranked = panel.ranked
    dots = [
        [_rate_dot(each.rates.get(NONE)) for each in ranked],
        [_rate_dot(each.perturbed) for each in ranked],
    ]
    rows = [each.policy for each in ranked]
    return Block(panel.name, rows, [DotColumn(RATE_LABEL, dict(enumerate(dots)), (-2, 102))])


def _rate_dot(found: Rate | None) -> Dot | None:
    return None if found is None else _dot(found.share, found.interval)


def _cost_dot(found: PairedComparison | None) -> Dot | None:
    return None if found is None else _dot(found.counts.difference, found.interval, found.is_shown)


def _dot(share: float, interval: tuple[float, float] | None, is_filled: bool = True) -> Dot:
    low, high = (None, None) if interval is None else (100 * bound for bound in interval)
    return Dot(100 * share, low, high, is_filled)


def _summary(report: Report) -> Table:
    header = ["policy, suite", "unperturbed", "perturbed", "on shared episodes", "measures", "episodes"]
    rows, notes = [], dict[str, str]()
    for panel in report.panels:
        _kind, shared = panel.shared
        for place, series in enumerate(panel.series):
            group = series.group
            measures = measured(group.nominal or group.records)
            notes |= {measure.name: measure.note for measure in measures}
            cells = [rate(group.nominal), rate(group.perturbed)]
            cells.append(rate(shared[place]) if len(panel.series) > 1 and shared else Cell("-"))
            told = ", ".join(f"{measure.name} {value}" for measure, value in measures.items())
            total = len(group.records)
            rows.append([Cell(group.name), *cells, Cell(told), Cell(str(total), total)])
    note = "; ".join([SUMMARY_NOTE, *(f"{name}: {told}" for name, told in notes.items() if told)])
    return Table("", header, rows, f"{note}.")


def conditions(series: Series) -> Table:
    """Write the table of success under each condition, and its cost against the same episodes unperturbed."""
    costs = series.costs
    blank = [Cell(""), Cell("")] if costs else []

    def row(condition: AxisCondition) -> list[Cell]:
        records = series.records[condition]
        cost = points(costs[condition]) if condition in costs else blank
        return [Cell(condition), rate(records), Cell(str(len(records)), len(records)), *cost]

    note = f"Success in per cent, with {INTERVALS}."
    if costs:
        note += (
            " Points: difference in percentage points from the same episodes unperturbed, with "
            f"{PAIRED_INTERVAL}; p: {describe_test(costs.values())}."
        )
    header = ["condition", "success", "episodes", *(["points", "p"] if costs else [])]
    return Table(series.group.name, header, [row(condition) for condition in series.records], note)
