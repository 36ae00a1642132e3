"""Success rates on a card: a sentence, a figure and a table."""

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING

from lerobot_bomb.conditions import NONE
from lerobot_bomb.hub.markdown import code, plain
from lerobot_bomb.results.groups import Group, by_condition, rate_of
from lerobot_bomb.results.record import NO_VALUE, Record
from lerobot_bomb.results.summary import named_counts, summarise
from lerobot_bomb.stats import Rate

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FIGURE = "success_rates.png"  # beside the card: the Hub drops SVG that stands in it
MAX_ROWS = 30  # conditions of a group in the figure: the unperturbed one, then those with the lowest rates
MAX_TITLE = 70  # characters
ROW_INCHES, WIDTH_INCHES, DPI = 0.24, 7.0, 150
DOT_RGB, GRID_RGB = "#0072B2", "#DDDDDD"  # Okabe-Ito's blue

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
        worst = next(iter(rates))
        of_all = f", the lowest of {len(rates)} conditions" if len(rates) > 1 else ""
        parts.append(f"{rates[worst]} under {code(worst)}{of_all}")
    methods = ", ".join(dict.fromkeys(rate.method for rate in rates_of(group).values()))
    return f"{plain(_title(group))}: {'; '.join(parts)} ({methods})."


def figure(groups: Sequence[Group]) -> bytes:
    """Draw each condition's rate with its interval, one panel for each group, as a PNG."""
    from matplotlib.figure import Figure

    shown = [dict(list(rates_of(group).items())[:MAX_ROWS]) for group in groups]
    heights = [len(rates) + 3 for rates in shown]
    drawing = Figure(figsize=(WIDTH_INCHES, ROW_INCHES * sum(heights) + 0.3), dpi=DPI, layout="constrained")
    panels = drawing.subplots(len(groups), 1, squeeze=False, height_ratios=heights)[:, 0]
    for panel, group, rates in zip(panels, groups, shown, strict=True):
        _draw(panel, rates)
        left_out = len(by_condition(group.records)) - len(rates)
        note = f" ({left_out} conditions with higher rates are not shown)" if left_out else ""
        panel.set_title(_cut(_title(group)) + note, fontsize=9, loc="left", parse_math=False)
    panels[-1].set_xlabel("success, %, with 95 % interval", fontsize=8)
    file = io.BytesIO()
    drawing.savefig(file, format="png")
    return file.getvalue()


def _draw(panel: "Axes", rates: Rates) -> None:
    places = range(len(rates))
    for place, rate in zip(places, rates.values(), strict=True):
        low, high = rate.interval or (rate.share, rate.share)
        panel.plot([100 * low, 100 * high], [place, place], color=DOT_RGB, linewidth=1.5)
        panel.plot(100 * rate.share, place, "o", color=DOT_RGB, markersize=5, clip_on=False)
        panel.annotate(
            f"{rate.successes}/{rate.n}", (1.02, place), fontsize=8, va="center",
            xycoords=panel.get_yaxis_transform(),
        )  # fmt: skip
    panel.set_yticks(places, ["unperturbed" if name == NONE else _cut(name) for name in rates], fontsize=8)
    panel.set_xlim(0, 100)
    panel.set_ylim(len(rates) - 0.5, -0.5)
    panel.tick_params(axis="x", labelsize=8)
    panel.tick_params(axis="y", length=0)
    panel.grid(axis="x", color=GRID_RGB, linewidth=0.6)
    panel.set_axisbelow(True)
    panel.spines[["top", "right", "left"]].set_visible(False)


def results_table(group: Group) -> str:
    """Return Markdown: the evaluation, and a row for each condition."""
    _, *settings = group.lines()  # the policy is the checkpoint
    summaries = {condition: summarise(records) for condition, records in by_condition(group.records).items()}
    measures = [
        measure
        for measure in group.record_type.measures
        if any(summary.measures[measure] != NO_VALUE for summary in summaries.values())
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
            *(summary.measures[each] for each in measures),
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


def suite_or_task(record: Record) -> str:
    """Return the suite of an episode, or its task where the environment has no suites."""
    return getattr(record.spec, "suite", record.tasks[0])


def _title(group: Group) -> str:
    first = group.records[0]
    return f"{first.benchmark()}, {suite_or_task(first)}"


def _cut(text: str) -> str:
    return text if len(text) <= MAX_TITLE else f"{text[: MAX_TITLE - 1]}…"
