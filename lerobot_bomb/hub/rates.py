"""Success rates on a card: a sentence, a figure and a table."""

from collections.abc import Sequence

from lerobot_bomb.conditions import NONE
from lerobot_bomb.hub.markdown import code, plain
from lerobot_bomb.report.chart import Chart
from lerobot_bomb.report.report import Report
from lerobot_bomb.report.sections import answer
from lerobot_bomb.results.groups import Group, by_condition, rate_of, suite_or_task
from lerobot_bomb.results.summary import named_counts, summarise
from lerobot_bomb.stats import Rate

FIGURE = "success_rates.svg"  # beside the card: the Hub drops SVG that stands in it

type Rates = dict[str, Rate]  # {condition: rate}


def rates_of(group: Group) -> Rates:
    """Return the rate of each condition: first the unperturbed one, then the lowest."""
    rates = {str(name): rate_of(records) for name, records in by_condition(group.records).items()}
    names = sorted(rates, key=lambda name: (name != NONE, rates[name].share, name))
    return {name: rates[name] for name in names}


def headline(group: Group) -> str:
    """Say in a sentence how often the policy succeeds, unperturbed and where it is worst, as Markdown."""
    rates = rates_of(group)
    parts = []
    if NONE in rates:
        parts.append(f"**{rates.pop(NONE)}** unperturbed")
    if rates:
        worst, *others = rates
        is_lowest = all(rates[worst].share < rates[other].share for other in others)
        of_all = "the lowest of" if is_lowest else "none lower in"
        of_all = f", {of_all} {len(rates)} conditions" if others else ""
        parts.append(f"{rates[worst]} under {code(worst)}{of_all}")
    methods = ", ".join(dict.fromkeys(rate.method for rate in rates_of(group).values()))
    return f"{plain(_title(group))}: {'; '.join(parts)} ({methods})."


def rates_chart(groups: Sequence[Group]) -> Chart:
    """Return the report's chart of each condition's rate with its interval."""
    (chart,) = answer.section(Report([*groups])).charts
    return chart


def results_table(group: Group) -> str:
    """Return Markdown: the evaluation, and a row for each condition."""
    _, *settings = group.lines()  # the policy is the checkpoint
    summaries = {condition: summarise(records) for condition, records in by_condition(group.records).items()}
    measures = [
        measure
        for measure in group.record_type.measures
        if any(measure in summary.measures for summary in summaries.values())
    ]
    intervals = ", ".join(dict.fromkeys(summary.rate.method for summary in summaries.values()))
    names = [f"{measure.name} ({measure.note})" if measure.note else measure.name for measure in measures]
    columns = ["condition", f"success ({intervals})", *names, "failures"]
    lines = [
        plain(f"{group.record_type.describe_tasks(group.records)}; {'; '.join(settings)}:"),
        "",
        f"| {' | '.join(columns)} |",
        "|---" * len(columns) + "|",
    ]
    for condition, summary in summaries.items():
        cells = [
            f"perturbations={condition}",
            str(summary.rate),
            *(summary.measures.get(each, "-") for each in measures),
        ]
        lines.append(f"| {' | '.join(map(plain, [*cells, named_counts(summary.failures)]))} |")
    return "\n".join(lines)


def mostly_failing(groups: Sequence[Group]) -> list[str]:
    """Return the conditions under which a policy fails more often than not, with counts, as Markdown."""
    return [
        f"{code(name)} ({rate.successes}/{rate.n})"
        for group in groups
        for name, rate in rates_of(group).items()
        if 2 * rate.successes < rate.n
    ]


def _title(group: Group) -> str:
    first = group.records[0]
    return f"{first.benchmark()}, {suite_or_task(first)}"
