"""Success rates as a table for a paper."""

from collections.abc import Sequence

from lerobot_bomb.report.cells import INTERVALS, rate
from lerobot_bomb.results.groups import Group, by_condition

SPECIAL = {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    **{character: f"\\{character}" for character in "_%&#${}"},
}  # fmt: skip


def latex_table(groups: Sequence[Group]) -> str:
    r"""Write a `tabular` of the package `booktabs`: a line for each condition, a column for each group."""
    by_group = [by_condition(group.records) for group in groups]
    conditions = list(dict.fromkeys(condition for by in by_group for condition in by))
    numbers = sorted({len(records) for by in by_group for records in by.values()})
    lines = [
        r"\begin{tabular}{l" + "r" * len(groups) + "}",
        r"\toprule",
        _line("condition", *(group.name for group in groups)),
        r"\midrule",
        *(
            _line(condition, *(rate(by.get(condition, [])).text for by in by_group))
            for condition in conditions
        ),
        r"\bottomrule",
        r"\end{tabular}",
    ]
    episodes = " or ".join(map(str, numbers))
    note = f"% success, with {INTERVALS}; {episodes} episodes each\n"
    return note + "\n".join(lines) + "\n"


def _line(*cells: str) -> str:
    return " & ".join(map(_escaped, cells)) + r" \\"


def _escaped(text: str) -> str:
    return "".join(SPECIAL.get(character, character) for character in text)
