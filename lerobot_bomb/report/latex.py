"""Success rates as tables for a paper, in LaTeX with the package `booktabs`."""

from collections.abc import Iterator, Sequence
from itertools import combinations

from lerobot_bomb.files import file_names
from lerobot_bomb.report.cells import INTERVALS, PAIRED_INTERVAL
from lerobot_bomb.report.panels import Panel, Series, panels_of
from lerobot_bomb.results.comparison import Comparisons, compare
from lerobot_bomb.results.groups import (
    PER_TASK,
    POLICY,
    Group,
    Policy,
    by_condition,
    differing,
    groups_of,
    policies_of,
    rate_of,
)
from lerobot_bomb.results.pairs import PairedComparison, describe_test
from lerobot_bomb.results.record import describe_numbers
from lerobot_bomb.stats import SIGNIFICANT, Rate
from lerobot_bomb.tables import printable, shorten_all

SPECIAL = {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}",
    **{character: f"\\{character}" for character in "_%&#${}"},
}  # fmt: skip
NEEDS = "% needs \\usepackage{booktabs}\n"
NOTHING = "--"  # in a cell
MAX_BESIDE = 3  # policies in columns of their own; more stand below each other
SMALLEST_P = 0.001
STATED = (POLICY, *PER_TASK)  # settings that every table says

type Wins = set[tuple[str, str, str]]  # the first group's name, which is better than the second's


def latex_tables(groups: Sequence[Group]) -> str:
    """Write a `table` for each suite: success and its change, conditions by policies; the best in bold."""
    panels = panels_of(groups)
    first = [panel.series[0].group for panel in panels]
    labels = file_names([_label(group) for group in first])
    apart = [name for name in differing(first) if name not in STATED]
    wins = _wins(groups, panels)
    return NEEDS + "\n".join(
        _written(panel, label, apart, wins) for panel, label in zip(panels, labels, strict=True)
    )


def comparison_table(comparisons: Comparisons) -> str:
    """Write a `table` of two policies on the same episodes; the better in bold."""
    conditions = comparisons.conditions
    groups = groups_of(record for each in conditions for pair in each.pairs for record in pair)
    short = shorten_all(comparisons.names)
    a, b = (_escaped(short[name]) for name in comparisons.names)
    caption = (
        f"{_where(groups, f' of {a} (A) and {b} (B)')}. B $-$ A: in points, on the same episodes, with "
        f"{_escaped(PAIRED_INTERVAL)}; $p$: {_escaped(describe_test(conditions))}. "
        f"Bold: better, $p < {SIGNIFICANT}$. {_simulated(groups)}"
    )
    header = [_line("condition", "A", "B", "B $-$ A", "$p$", "pairs")]
    return NEEDS + _float(caption, "comparison", "lrrrrr", header, [*map(_compared_line, conditions)])


def _compared_line(compared: PairedComparison) -> str:
    difference = compared.counts.difference
    is_better = compared.is_shown and difference < 0, compared.is_shown and difference > 0
    rates = [rate_of(list(records)) for records in zip(*compared.pairs, strict=True)]
    interval = "" if compared.interval is None else f" [{', '.join(map(_points, compared.interval))}]"
    return _line(
        _escaped(compared.condition),
        *map(_rate, rates, is_better),
        f"{_points(difference)}{interval}",
        _p(compared.p_value),
        str(compared.counts.n),
    )


def _wins(groups: Sequence[Group], panels: list[Panel]) -> Wins:
    """Return where a group is better than another, as `compare` tests it; of those that may be the best."""
    names = {id(record): group.name for group in groups for record in group.records}
    leading = {policy for panel in panels for policy in _leading(panel)}
    wins: Wins = set()
    for pair in combinations(policies_of(groups), 2):
        if not leading.isdisjoint(policy.short_name for policy in pair):
            for each in _compared(*pair):
                better, worse = each.pairs[0] if each.counts.difference < 0 else each.pairs[0][::-1]
                if each.is_shown:
                    wins.add((names[id(better)], names[id(worse)], better.spec.perturbations))
    return wins


def _leading(panel: Panel) -> Iterator[str]:
    """Yield the policies that have the highest rate under some condition."""
    for condition in panel.conditions:
        having = [each for each in panel.series if condition in each.rates]
        if len(having) > 1:
            yield max(having, key=lambda each: each.rates[condition].share).policy


def _compared(first: Policy, second: Policy) -> list[PairedComparison]:
    try:
        return compare(first.records, second.records).conditions
    except ValueError:  # no episode in common
        return []


def _is_best(series: Series, condition: str, panel: Panel, wins: Wins) -> bool:
    """Return True if a policy is better than every other that has the condition."""
    others = [each for each in panel.series if each is not series and condition in each.rates]
    return bool(others) and all(
        series.rates[condition].share > each.rates[condition].share
        and (series.group.name, each.group.name, condition) in wins
        for each in others
    )


def _written(panel: Panel, label: str, apart: list[str], wins: Wins) -> str:
    has_changes = any(each.costs for each in panel.series)
    columns = ["success", *(["change", "$p$"] if has_changes else [])]
    conditions = list(dict.fromkeys(condition for each in panel.series for condition in each.rates))
    best = {
        (each.group.name, condition)
        for each in panel.series
        for condition in each.rates
        if _is_best(each, condition, panel, wins)
    }
    cells = {
        (each.group.name, condition): _cells(each, condition, best, len(columns))
        for each in panel.series
        for condition in conditions
    }
    write = _beside if len(panel.series) <= MAX_BESIDE else _below
    caption = _caption(panel, apart, is_bold=bool(best))
    return _float(caption, label, *write(panel, conditions, columns, cells))


type _Cells = dict[tuple[str, str], list[str]]  # of a group's name and a condition


def _beside(
    panel: Panel, conditions: list[str], columns: list[str], cells: _Cells
) -> tuple[str, list[str], list[str]]:
    """Return alignment, header and lines of a table with the policies beside each other."""
    several, width = panel.series, len(columns)
    names = [_name(each, panel) for each in several]
    header = [_line("condition", *names)] if width == 1 else _spanned(names, columns)
    lines = [
        _line(_escaped(condition), *(cell for each in several for cell in cells[each.group.name, condition]))
        for condition in conditions
    ]
    return "l" + "r" * width * len(several), header, lines


def _spanned(names: list[str], columns: list[str]) -> list[str]:
    """Return a header with names above columns that they all have."""
    width = len(columns)
    above = [rf"\multicolumn{{{width}}}{{c}}{{{name}}}" for name in names]
    starts = [2 + place * width for place in range(len(names))]
    rules = " ".join(rf"\cmidrule(lr){{{start}-{start + width - 1}}}" for start in starts)
    return [_line("", *above), rules, _line("condition", *columns * len(names))]


def _below(
    panel: Panel, conditions: list[str], columns: list[str], cells: _Cells
) -> tuple[str, list[str], list[str]]:
    """Return alignment, header and lines of a table with the policies below each other."""
    lines: list[str] = []
    for condition in conditions:
        having = [each for each in panel.series if condition in each.rates]
        lines += [r"\addlinespace"] if lines else []
        for place, each in enumerate(having):
            first = "" if place else _escaped(condition)
            lines.append(_line(first, _name(each, panel), *cells[each.group.name, condition]))
    return "ll" + "r" * len(columns), [_line("condition", "policy", *columns)], lines


def _name(series: Series, panel: Panel) -> str:
    return _escaped(panel.short_names[series.policy])


def _cells(series: Series, condition: str, best: set[tuple[str, str]], number: int) -> list[str]:
    if condition not in series.rates:
        return [NOTHING] * number
    cells = [_rate(series.rates[condition], (series.group.name, condition) in best)]
    if (change := series.costs.get(condition)) is not None:
        cells += [_points(change.counts.difference), _p(change.p_value)]
    return cells + [NOTHING] * (number - len(cells))


def _caption(panel: Panel, apart: list[str], is_bold: bool) -> str:
    groups = [each.group for each in panel.series]
    changes = [change for each in panel.series for change in each.costs.values()]
    parts = [f"{_where(groups)}."]
    if changes:
        test = _escaped(describe_test(changes))
        parts.append(f"Change: in points, from the same episodes unperturbed; $p$: {test}.")
    if len(groups) > 1:
        test = f"$p < {SIGNIFICANT}$, exact McNemar test on the same episodes, adjusted for conditions (Holm)"
        claim = "Bold: better" if is_bold else "Under no condition is a policy shown to be better"
        parts.append(f"{claim} than every other one ({test}).")
    parts += [_escaped(f"{name}: {groups[0].settings.get(name, '')}.") for name in apart]
    return " ".join([*parts, _simulated(groups)])


def _where(groups: Sequence[Group], whose: str = "") -> str:
    """Return 'Success in % on BOMB, task version 1.0, suite place: 20 episodes each, seeds ...'."""
    benchmarks = dict.fromkeys(group.records[0].benchmark() for group in groups)
    suites = dict.fromkeys(suite for group in groups if (suite := group.settings.get("suite")))
    sizes = sorted({len(each) for group in groups for each in by_condition(group.records).values()})
    episodes = f"{sizes[0]}" if len(sizes) == 1 else f"{sizes[0]} to {sizes[-1]}"
    seeds = describe_numbers(each.spec.seed for group in groups for each in group.records)
    suite = f", suite {' and '.join(suites)}" if suites else ""
    seeds = seeds.replace("..", "--")
    number = f"{episodes} episode{'s' * (sizes[-1] > 1)} each, seeds {seeds}"
    text = f"{' and '.join(benchmarks)}{suite}: {number}, with {INTERVALS}"
    return rf"Success in \%{whose} on {_escaped(text)}"


def _simulated(groups: Sequence[Group]) -> str:
    """Return 'MuJoCo 3.8.1.'; of other simulators, their packages."""
    texts = dict.fromkeys(
        f"MuJoCo {settings['MuJoCo']}" if "MuJoCo" in settings else settings.get("simulator", "")
        for settings in (group.settings for group in groups)
    )
    return _escaped(f"{' and '.join(filter(None, texts))}.")


def _label(group: Group) -> str:
    suite = group.settings.get("suite")
    return f"{group.record_type.env_type}-{suite}" if suite else group.record_type.env_type


def _float(caption: str, label: str, alignment: str, header: Sequence[str], lines: Sequence[str]) -> str:
    return "\n".join(
        [
            r"\begin{table}",
            r"\centering",
            rf"\caption{{{caption}}}",
            rf"\label{{tab:{label}}}",
            r"\footnotesize",
            rf"\begin{{tabular}}{{{alignment}}}",
            r"\toprule",
            *header,
            r"\midrule",
            *lines,
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table}",
            "",
        ]
    )


def _line(*cells: str) -> str:
    return " & ".join(cells) + r" \\"


def _rate(rate: Rate, is_bold: bool) -> str:
    text = rate.percent.replace(" %", "")
    return rf"\textbf{{{text}}}" if is_bold else text


def _points(share: float) -> str:
    return f"${100 * share:+.1f}$"


def _p(p_value: float) -> str:
    return rf"$<$ {SMALLEST_P}" if p_value < SMALLEST_P else f"{p_value:.2g}"


def _escaped(text: str) -> str:
    return "".join(SPECIAL.get(character, character) for character in printable(text))
