"""Comparison of two policies on the same episodes: which is better, by how much, and is it certain?"""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any

from lerobot_bomb.results.groups import POLICY, Group, by_condition, differing, groups_of, rate_of
from lerobot_bomb.results.names import policy_names
from lerobot_bomb.results.origin import NOT_RECORDED
from lerobot_bomb.results.pairs import (
    Pair,
    PairedComparison,
    are_clustered,
    compare_pairs,
    describe_test,
    episode_key,
)
from lerobot_bomb.results.record import Record
from lerobot_bomb.stats import format_bounds, format_p, points_format
from lerobot_bomb.tables import in_a_row

ABSENT = "none"  # value of a setting that a record lacks: SAPIEN of MuJoCo's, a flag that is null

type Values = dict[str, set[str]]  # of settings
type Settings = dict[str, str]  # {name: the value in a pair, or both values}


@dataclass(frozen=True)
class Comparisons:
    """Comparison of two sets of episodes, condition by condition."""

    policies: tuple[str, str]  # as records describe them
    names: tuple[str, str]  # the shortest that tell them apart
    conditions: list[PairedComparison]
    num_unpaired: tuple[int, int]  # episodes that the other policy did not run
    unpaired: tuple[list[str], list[str]]  # conditions none of whose episodes the other policy ran

    @property
    def lowest(self) -> tuple[float, str]:
        """Points by which B is better at least, under every condition, and how they are known.

        -inf if they are not: a condition has no pairs, or all its pairs are of one start.
        """
        if lacking := self.without_pairs:
            return -inf, lacking
        if of_one_seed := [each.condition for each in self.conditions if each.interval is None]:
            return -inf, f"all pairs are of one seed under {in_a_row(of_one_seed)}"
        low = 100 * min(each.interval[0] for each in self.conditions if each.interval is not None)
        return low, f"lowest end of an interval {low:+.1f}"

    @property
    def without_pairs(self) -> str:
        """Text 'no pairs under camera:3 of A'; '' if each condition of both has some."""
        lacking = zip("AB", self.unpaired, strict=True)
        told = [f"{in_a_row(conditions)} of {side}" for side, conditions in lacking if conditions]
        return f"no pairs under {in_a_row(told)}" if told else ""

    def verdicts(self) -> list[str]:
        """Say under which conditions which policy is better."""
        if len(self.conditions) == 1:
            return [describe_verdict(self.conditions[0])]
        signs = [each.counts.difference > 0 for each in self.conditions if each.is_shown]
        number, num_better = len(self.conditions), sum(signs)
        parts = [f"B is better under {num_better}"] if num_better else []
        parts += [f"A is better under {len(signs) - num_better}"] if num_better < len(signs) else []
        number_left = number - len(signs) if signs else "any"
        parts += [f"no significant difference under {number_left}"] if len(signs) < number else []
        lines = [f"{each.condition}: {describe_verdict(each)}" for each in self.conditions]
        return [f"of {number} conditions: {', '.join(parts)}", *(f"  {line}" for line in lines)]

    def lines(self) -> list[str]:
        """Return the verdicts, then the comparisons, as lines of text."""
        a, b = self.names
        lines = [f"A is {a}, B is {b}", *self.verdicts(), ""]
        lines += [f"{name}: {policy}" for name, policy in zip("AB", self.policies, strict=True)]
        is_same = self.policies[0] == self.policies[1] != NOT_RECORDED
        lines += ["A and B are the same policy"] if is_same else []
        for each in self.conditions:
            lines += [f"{each.condition}: {_num_pairs(each)}", *(f"  {line}" for line in _lines(each))]
        if any(self.num_unpaired):
            a, b = self.num_unpaired
            told = f"not compared, since only one has them: {a} episodes of A, {b} of B"
            lines.append("; ".join(filter(None, [told, self.without_pairs])))
        notes = (
            "rates: 95 % Wilson intervals, clustered by seed; B - A: Newcombe's for pairs, likewise; p: "
            f"{describe_test(self.conditions)}"
        )
        if not are_clustered(self.conditions):
            notes += ", to be trusted where the two disagree, as with few pairs"
        return [*lines, notes]


def describe_verdict(compared: PairedComparison, first: str = "A", second: str = "B") -> str:
    """Return 'B is better by 28 points [12, 43] (40 pairs, p = 0.0068)', or that this is not significant."""
    counts = compared.counts
    pairs = _num_pairs(compared)
    if counts.difference == 0:
        return f"they tie ({counts.first} success{'es' * (counts.first != 1)} each in {pairs})"
    better, interval = second, compared.interval
    if counts.difference < 0:
        better, interval = first, interval and (-interval[1], -interval[0])
    form = points_format(counts.difference)
    points = f"{100 * abs(counts.difference):{form}} points{format_bounds(interval, form, 100)}"
    test = f"{pairs}, {format_p(compared.p_value)}"
    if compared.is_shown:
        return f"{better} is better by {points} ({test})"
    needed = f"; about {compared.num_needed:,} pairs would settle it" if compared.num_needed else ""
    why = "not shown" if compared.is_significant else "not significant"
    return f"{why}: {better} leads by {points} ({test}{needed})"


def _num_pairs(compared: PairedComparison) -> str:
    of_seeds = f" of {compared.num_starts} seed{'s' * (compared.num_starts != 1)}"
    number = len(compared.pairs)
    return f"{number} pair{'s' * (number != 1)}{of_seeds * compared.is_clustered}"


def _lines(compared: PairedComparison) -> list[str]:
    """Return the pairs of a condition as lines of text."""
    counts, change = compared.counts, compared.describe_change()
    rates = [rate_of(list(records)) for records in zip(*compared.pairs, strict=True)]
    return [
        *(f"{name}          {rate}" for name, rate in zip("AB", rates, strict=True)),
        f"B - A      {compared.describe_difference(' points')}; A alone succeeded in {counts.only_first}, "
        f"B alone in {counts.only_second} of {counts.n} pairs, {format_p(compared.p_value)}",
        *([f"           {change}"] if change else []),
    ]


def have_pairs(first: Group, second: Group) -> bool:
    """Return True if two groups differ in nothing but policy and have an episode in common."""
    if not can_compare(first, second):
        return False
    keys, others = ({episode_key(record, None) for record in group.records} for group in (first, second))
    return not keys.isdisjoint(others)


def can_compare(first: Group, second: Group, across: Collection[str] = ()) -> bool:
    """Return True if two groups differ in nothing but policy and these settings, as far as records say."""
    return not kept_apart(first, second, across)


def kept_apart(first: Group, second: Group, across: Collection[str] = ()) -> list[str]:
    """Return the settings, but policy and these, in which two groups differ, as far as records say."""
    return _apart(_values_of([first]), _values_of([second]), across)


def compare(
    first: Sequence[Record],
    second: Sequence[Record],
    names: Mapping[str, str] | None = None,
    across: str | None = None,
) -> Comparisons:
    """Pair the episodes of two policies, or of one policy across a setting.

    Args:
        first: records of one side.
        second: records of the other.
        names: {key of a policy: its name}.
        across: setting in which the sides differ, one of the records' `comparable`.

    Raises:
        ValueError: one side has several policies, or there is no pair; names what differs.
    """
    groups = groups_of(first), groups_of(second)
    policies = _only_policy("the first", groups[0]), _only_policy("the second", groups[1])
    pairs = list(_pairs(*groups, across))
    if not pairs:
        raise ValueError(f"no episode is in both: {_why_none(*groups, across)}")
    num_first, num_second = (sum(len(group.records) for group in policy_groups) for policy_groups in groups)
    first_paired, second_paired = ({id(pair[side]) for _, pair in pairs} for side in (0, 1))
    return Comparisons(
        policies=policies,
        names=_names(groups[0][0], groups[1][0], names, across),
        conditions=compare_pairs(_by_condition(pairs)),
        num_unpaired=(num_first - len(pairs), num_second - len(pairs)),
        unpaired=(_unpaired(groups[0], first_paired), _unpaired(groups[1], second_paired)),
    )


def _names(
    first: Group, second: Group, given: Mapping[str, str] | None, across: str | None
) -> tuple[str, str]:
    """Name the sides: by their policies, or across a setting by its values."""
    a, b = (group.records[0].policy for group in (first, second))
    if across is None:
        name, other = policy_names([a, b], given)
        return name, other
    (name,) = policy_names([a], given)
    return f"{name}, {across} {first.settings[across]}", f"{name}, {across} {second.settings[across]}"


def _by_condition(pairs: list[tuple[Settings, Pair]]) -> dict[str, list[Pair]]:
    """Split pairs by condition, and by every setting with several values, such as the suite."""
    settings = [dict(items) for items in dict.fromkeys(tuple(each.items()) for each, _ in pairs)]
    names = dict.fromkeys(name for values in settings for name in values if name != POLICY)
    several = [name for name in names if len({values.get(name) for values in settings}) > 1]
    labelled: dict[str, list[Pair]] = {}
    for values, pair in pairs:
        label = _condition_label(several, values, pair[0].spec.perturbations)
        labelled.setdefault(label, []).append(pair)
    return labelled


def _condition_label(names: Iterable[str], values: Settings, perturbations: str) -> str:
    """Return 'place, fps 20, camera:3': these settings and the perturbations."""
    shown = ((name, values.get(name, ABSENT)) for name in names)
    return ", ".join(
        [*(value if name == "suite" else f"{name} {value}" for name, value in shown), perturbations]
    )


def _unpaired(groups: list[Group], paired: set[int]) -> list[str]:
    """Return the conditions of groups of which no record, by its id, has a pair."""
    several = differing(groups)
    return [
        _condition_label(several, group.settings, condition)
        for group in groups
        for condition, records in by_condition(group.records).items()
        if paired.isdisjoint(map(id, records))
    ]


def _only_policy(name: str, groups: list[Group]) -> str:
    described = {group.settings[POLICY]: group.records[0].describe_policy() for group in groups}
    if len(described) > 1:
        texts = "; ".join(sorted(set(described.values())))
        raise ValueError(
            f"{name} results are of {len(described)} policies ({texts}): compare two of one file with "
            "--policies=A,B"
        )
    return groups[0].records[0].describe_policy()


def _pairs(first: list[Group], second: list[Group], across: str | None) -> Iterator[tuple[Settings, Pair]]:
    """Yield each pair with the settings of both records."""
    settings = _settings_across(first, across)
    candidates: dict[Any, list[tuple[int, Record]]] = {}
    for place, group in enumerate(second):
        for record in group.records:
            candidates.setdefault(episode_key(record, across), []).append((place, record))
    for group in first:
        joined = {
            place: _join(group, other)
            for place, other in enumerate(second)
            if can_compare(group, other, settings)
        }
        for record in group.records:
            of_episode = candidates.get(episode_key(record, across), [])
            places = [place for place, (number, _) in enumerate(of_episode) if number in joined]
            if places:
                number, other = of_episode.pop(places[0])
                yield joined[number], (record, other)


def _join(first: Group, second: Group) -> Settings:
    """Return the settings of both groups; what only one recorded holds for both."""
    joined = {}
    for name in first.settings | second.settings:
        values = dict.fromkeys(each.settings.get(name, ABSENT) for each in (first, second))
        joined[name] = " and ".join(value for value in values if value != NOT_RECORDED) or NOT_RECORDED
    return joined


def _settings_across(groups: list[Group], across: str | None) -> tuple[str, ...]:
    """Return the settings that differ where this one does."""
    return () if across is None else (across, *groups[0].record_type.comparable[across])


def _values_of(groups: list[Group]) -> Values:
    """Return {setting: its values in these groups}."""
    names = {name: None for group in groups for name in group.settings}
    return {name: {group.settings.get(name, ABSENT) for group in groups} for name in names}


def _apart(first: Values, second: Values, across: Collection[str] = ()) -> list[str]:
    """Return the settings in which the two have no value in common.

    A setting that was not recorded keeps no episodes apart: an expert is shown no image, so OpenGL drew none.
    """
    apart = []
    for name in first | second:
        values, others = first.get(name, {ABSENT}), second.get(name, {ABSENT})
        if name not in (POLICY, *across) and not values & others and NOT_RECORDED not in values | others:
            apart.append(name)
    return apart


def _why_none(first: list[Group], second: list[Group], across: str | None) -> str:
    if apart := _apart(_values_of(first), _values_of(second), _settings_across(first, across)):
        return f"they differ in {', '.join(apart)}"
    return "seeds, conditions or tasks have nothing in common; evaluate both with the same --seed and flags"
