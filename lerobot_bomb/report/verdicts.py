"""Verdicts over records: ways in which a success rate can be wrong, question by question.

Groups hold records of the same episodes, except those of the splits.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from lerobot_bomb.report.cells import INTERVALS, rate
from lerobot_bomb.report.table import Cell, Table
from lerobot_bomb.results.groups import rate_of
from lerobot_bomb.results.pairs import Pair, count_pairs, pairs_of
from lerobot_bomb.results.record import Record, different_fields
from lerobot_bomb.stats import SIGNIFICANT, PairedCounts, fisher_p_value, format_p

POLICY, AGAIN, ALONE = "the policy", "again, in another process", "one episode at a time"
BLANK, OTHER_INSTRUCTION = "with black images", "with another episode's instruction"
RANDOM, EXPERT = "random actions", "the scripted expert"
TRAIN, HELDOUT = "what training shows (split train)", "what is held out (split heldout)"

YES, NO, OPEN = "yes", "NO", "not shown"
P_NOTE = "p: exact McNemar test, or Fisher's where it says so; not adjusted for the number of questions."


@dataclass(frozen=True)
class Verdict:
    """A question, its answer, and its evidence."""

    question: str
    answer: str  # YES, NO, or OPEN: these episodes do not show it
    evidence: str


def verdict_tables(groups: Mapping[str, list[Record]], verdicts: list[Verdict]) -> list[Table]:
    """Return the verdicts, and the rates of all groups."""
    rates = [
        [Cell(name), rate(records), Cell(str(len(records)), len(records))]
        for name, records in groups.items()
        if records
    ]
    answers = [[Cell(each.question), Cell(each.answer), Cell(each.evidence)] for each in verdicts]
    return [
        Table("Verdicts", ["question", "answer", "evidence"], answers, P_NOTE),
        Table("Success", ["policy", "success", "episodes"], rates, f"With {INTERVALS}; per cent."),
    ]


def judge(groups: Mapping[str, list[Record]], trained_seeds: Sequence[int] | None) -> list[Verdict]:
    """Judge every question that the groups can answer."""
    policy = groups[POLICY]
    found = [_same_again(pairs_of(policy, groups[AGAIN]))]
    if groups.get(ALONE):
        found.append(_same_alone(pairs_of(policy, groups[ALONE])))
    for name, question in ((BLANK, "looks at the images"), (OTHER_INSTRUCTION, "reads the instruction")):
        if groups.get(name):
            found.append(_depends(question, name, pairs_of(policy, groups[name])))
    if groups.get(RANDOM):
        found.append(_better_than_random(pairs_of(groups[RANDOM], policy)))
    if groups.get(EXPERT):
        found.append(_can_be_solved(groups[EXPERT]))
    if groups.get(HELDOUT):
        found.append(_generalises(groups[TRAIN], groups[HELDOUT]))
    return [*found, _new_seeds(policy, trained_seeds)]


def _p(counts: PairedCounts) -> str:
    return f"{format_p(counts.p_value)}, not adjusted"


def _same_again(pairs: list[Pair]) -> Verdict:
    question = "the same flags give the same episodes"
    for record, other in pairs:
        if names := different_fields(record, other):
            return Verdict(question, NO, f"seed {record.spec.seed} differs in {names[0]}")
    return Verdict(question, YES, f"{len(pairs)} of {len(pairs)}, bit for bit")


def _same_alone(pairs: list[Pair]) -> Verdict:
    counts = count_pairs(pairs)
    num_other = counts.only_first + counts.only_second
    num_equal = sum(not different_fields(*pair) for pair in pairs)
    evidence = (
        f"{num_other} of {counts.n} episodes end otherwise ({_p(counts)}), "
        f"{num_equal} are the same bit for bit"
    )
    answer = NO if counts.p_value < SIGNIFICANT else YES
    return Verdict("the batch size does not change the success rate", answer, evidence)


def _depends(question: str, name: str, pairs: list[Pair]) -> Verdict:
    counts = count_pairs(pairs)
    if not any(different_fields(*pair) for pair in pairs):
        return Verdict(question, NO, f"{name} all {counts.n} episodes are the same, bit for bit")
    shown = f"{counts.first} of {counts.n} become {counts.second} {name} ({_p(counts)})"
    is_worse = counts.p_value < SIGNIFICANT and counts.difference < 0
    return Verdict(question, YES if is_worse else OPEN, shown)


def _better_than_random(pairs: list[Pair]) -> Verdict:
    counts = count_pairs(pairs)
    is_better = counts.p_value < SIGNIFICANT and counts.difference > 0
    shown = f"{counts.second} of {counts.n}, random actions {counts.first} ({_p(counts)})"
    return Verdict("better than random actions", YES if is_better else OPEN, shown)


def _can_be_solved(records: list[Record]) -> Verdict:
    rate = rate_of(records)
    answer = YES if rate.successes == rate.n else NO
    return Verdict("every episode can be solved", answer, str(rate))


def _generalises(train: list[Record], heldout: list[Record]) -> Verdict:
    shown, held = (sum(each.is_success for each in records) for records in (train, heldout))
    p_value = fisher_p_value(shown, len(train), held, len(heldout))
    is_worse = p_value < SIGNIFICANT and held / len(heldout) < shown / len(train)
    evidence = (
        f"{held} of {len(heldout)} held out, {shown} of {len(train)} others "
        f"(Fisher's {format_p(p_value)}, not adjusted)"
    )
    return Verdict("does as well on what is held out", NO if is_worse else YES, evidence)


def _new_seeds(records: list[Record], trained: Sequence[int] | None) -> Verdict:
    question = "evaluates only episodes outside the training"
    if trained is None:
        return Verdict(question, OPEN, "a training or its dataset is not here, or does not say its seeds")
    seen = sorted({each.spec.seed for each in records} & set(trained))
    evidence = f"trained on seeds {trained[0]}..{trained[-1]}"
    return Verdict(question, NO if seen else YES, f"{evidence}{f', {len(seen)} evaluated' if seen else ''}")
