"""Two policies on the same episodes: which is better, by how much, and is it certain?"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from lerobot_bomb.checkpoints.shipped import checkpoint_path
from lerobot_bomb.envs.results import Row
from lerobot_bomb.evaluation.result_groups import (
    count_pairs,
    describe_change,
    describe_policy,
    groups_of,
    settings_of,
)
from lerobot_bomb.evaluation.result_kind import NOT_RECORDED, Pair
from lerobot_bomb.stats import (
    PairedCounts,
    episodes_to_tell_apart,
    format_rate,
    holm,
    paired_difference_interval,
)

POLICY = "policy"  # the one setting that the episodes of a pair may differ in

type Values = dict[str, set[str]]  # of settings


@dataclass(frozen=True)
class Comparison:
    """The episodes of one condition that both policies played."""

    condition: str
    pairs: list[Pair]  # of the first policy and of the second
    p_value: float  # adjusted for the number of conditions

    @property
    def counts(self) -> PairedCounts:
        """How often which of the two succeeded."""
        return count_pairs(self.pairs)

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the second rate minus the first."""
        return paired_difference_interval(self.counts)

    def lines(self) -> list[str]:
        """The comparison as text, a line each."""
        counts, (low, high) = self.counts, self.interval
        needed = episodes_to_tell_apart(counts)
        more = f"; {needed} pairs tell such a difference apart" if needed and low <= 0 <= high else ""
        change = describe_change(self.pairs)
        return [
            f"A          {format_rate(counts.first, counts.n)}",
            f"B          {format_rate(counts.second, counts.n)}",
            f"B - A      {100 * counts.difference:+.1f} points [{100 * low:+.1f}, {100 * high:+.1f}]; "
            f"A alone succeeded in {counts.only_first}, B alone in {counts.only_second} of {counts.n} pairs, "
            f"p = {self.p_value:.2g}{more}",
            *([f"           {change}"] if change else []),
        ]


@dataclass(frozen=True)
class Comparisons:
    """All that two sets of episodes have in common."""

    policies: tuple[str, str]
    conditions: list[Comparison]
    num_unpaired: tuple[int, int]  # episodes that the other policy did not play

    @property
    def lowest(self) -> float:
        """The lowest end of all intervals: the second policy is better by that much under every condition."""
        return min(each.interval[0] for each in self.conditions)

    def lines(self) -> list[str]:
        """The comparisons as text, a line each."""
        lines = [f"{name}: {policy}" for name, policy in zip("AB", self.policies, strict=True)]
        lines += ["A and B are the same policy"] if self.policies[0] == self.policies[1] else []
        for each in self.conditions:
            lines += [f"{each.condition}: {len(each.pairs)} pairs", *(f"  {line}" for line in each.lines())]
        if any(self.num_unpaired):
            a, b = self.num_unpaired
            lines.append(f"not compared, for the other did not play them: {a} episodes of A, {b} of B")
        notes = (
            "rates: 95 % Wilson intervals; B - A: Newcombe's for pairs; p: exact McNemar test, to be trusted "
            "where the two disagree, as with few pairs"
        )
        adjusted = f", adjusted for {len(self.conditions)} conditions (Holm)"
        return [*lines, notes + adjusted * (len(self.conditions) > 1)]


def of_policies(rows: list[Row], names: Sequence[str]) -> list[list[Row]]:
    """Apart by policy, those of each name; no name: of all, in the order of their first lines.

    A policy answers to its type, its path, `bomb:NAME`, or any part of what `results` says of it.

    Raises:
        ValueError: a name is of no policy, or of several.
    """
    of_key: dict[str, list[Row]] = {}
    for row in rows:
        of_key.setdefault(settings_of(row)[POLICY], []).append(row)
    described = {key: describe_policy(of[0]) for key, of in of_key.items()}
    if not names:
        return list(of_key.values())
    chosen = []
    for name in names:
        keys = [key for key, text in described.items() if name in text.split()] or [
            key for key, text in described.items() if checkpoint_path(name) in text
        ]
        if len(keys) != 1:
            texts = "; ".join(described.values())
            raise ValueError(f"--policies: {name} must name one policy of the file, not {len(keys)}: {texts}")
        chosen.append(of_key[keys[0]])
    return chosen


def compare(first: list[Row], second: list[Row]) -> Comparisons:
    """Pair the episodes of two policies.

    Raises:
        ValueError: either are of several policies, or there is no pair; it says what they differ in.
    """
    policies = _only_policy("the first", first), _only_policy("the second", second)
    pairs = list(_pairs(first, second))
    if not pairs:
        raise ValueError(f"no episode was played by both: {_why_none(first, second)}")
    return Comparisons(
        policies=policies,
        conditions=_by_condition(pairs),
        num_unpaired=(len(_episodes(first)) - len(pairs), len(_episodes(second)) - len(pairs)),
    )


def _by_condition(pairs: list[Pair]) -> list[Comparison]:
    """Apart by suite too, where there are several."""
    several = len({first["spec"].get("suite") for first, _ in pairs}) > 1
    of_label: dict[str, list[Pair]] = {}
    for pair in pairs:
        spec = pair[0]["spec"]
        label = f"{spec['suite']}, {spec['perturbations']}" if several else spec["perturbations"]
        of_label.setdefault(label, []).append(pair)
    adjusted = holm([count_pairs(of).p_value for of in of_label.values()])
    return [Comparison(label, of, p) for (label, of), p in zip(of_label.items(), adjusted, strict=True)]


def _only_policy(name: str, rows: list[Row]) -> str:
    settings = {settings_of(row)[POLICY] for row in rows}
    if len(settings) > 1:
        described = sorted({describe_policy(row) for row in rows})
        raise ValueError(
            f"{name} results are of {len(settings)} policies ({'; '.join(described)}): compare two of one "
            "file with --policies=A,B"
        )
    return describe_policy(rows[0])


def _pairs(first: list[Row], second: list[Row]) -> Iterator[Pair]:
    candidates: dict[str, list[tuple[Row, Values]]] = {}
    for row in _episodes(second):
        candidates.setdefault(_spec(row), []).append((row, _values_of([row])))
    for row in _episodes(first):
        of_spec, values = candidates.get(_spec(row), []), _values_of([row])
        if match := next((other for other in of_spec if not _apart(values, other[1])), None):
            of_spec.remove(match)
            yield row, match[0]


def _episodes(rows: list[Row]) -> list[Row]:
    """Each once: of an episode that was run again, the last one."""
    return [row for group in groups_of(rows) for row in group.rows]


def _spec(row: Row) -> str:
    return json.dumps(row["spec"], sort_keys=True)


def _values_of(rows: list[Row]) -> Values:
    """{setting: its values in these rows}."""
    settings = [settings_of(row) for row in rows]
    return {name: {of.get(name, NOT_RECORDED) for of in settings} for name in settings[0]}


def _apart(first: Values, second: Values) -> list[str]:
    """Names of the settings of which the two have no value in common.

    What was not recorded keeps no episodes apart: an expert is shown no image, so OpenGL drew none.
    """
    return [
        name
        for name, values in first.items()
        if name != POLICY
        and not values & second.get(name, set())
        and NOT_RECORDED not in values | second.get(name, set())
    ]


def _why_none(first: list[Row], second: list[Row]) -> str:
    if apart := _apart(_values_of(first), _values_of(second)):
        return f"they differ in {', '.join(apart)}"
    return "seeds, conditions or tasks have nothing in common; evaluate both with the same --seed and flags"
