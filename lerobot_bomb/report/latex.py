"""Success rates as a table for a paper."""

from collections.abc import Sequence

from lerobot_bomb.evaluation.result_groups import by_condition
from lerobot_bomb.report.arms import Arm
from lerobot_bomb.report.cells import INTERVALS, rate

SPECIAL = {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    **{character: f"\\{character}" for character in "_%&#${}"},
}  # fmt: skip


def table(arms: Sequence[Arm]) -> str:
    r"""A `tabular` of the package `booktabs`: a line for each condition, a column for each arm."""
    by_arm = [by_condition(arm.rows) for arm in arms]
    conditions = list(dict.fromkeys(condition for by in by_arm for condition in by))
    numbers = sorted({len(rows) for by in by_arm for rows in by.values()})
    lines = [
        r"\begin{tabular}{l" + "r" * len(arms) + "}",
        r"\toprule",
        _line("condition", *(arm.name for arm in arms)),
        r"\midrule",
        *(_line(condition, *(rate(by.get(condition, [])).text for by in by_arm)) for condition in conditions),
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
