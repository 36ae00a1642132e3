"""Sentences that say what the numbers say, and no more than their number of episodes allows."""

from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations

from lerobot_bomb.conditions import NONE, AxisCondition
from lerobot_bomb.report.panels import Panel, Series
from lerobot_bomb.report.table import Statement
from lerobot_bomb.results.comparison import Comparisons, describe_verdict
from lerobot_bomb.results.groups import rate_of, settings_of
from lerobot_bomb.results.pairs import PairedComparison
from lerobot_bomb.stats import Rate, format_p, points_format
from lerobot_bomb.tables import first_of, in_a_row

MAX_NAMED = 3  # names in a sentence
MAX_PLACES = 6  # of a ranking


def describe_series(series: Series, panel: Panel) -> Statement:
    """Say how often a policy succeeds, what it loses most to, and what is not known."""
    suite = f" on {panel.name}" if panel.name else ""
    nominal = series.rates.get(NONE)
    if nominal is not None:
        text = f"succeeds in {in_words(nominal)} unperturbed episodes{suite}"
    elif series.perturbed is not None:
        text = (
            f"has no unperturbed episodes{suite}; it succeeds in {in_words(series.perturbed)} perturbed ones"
        )
    else:
        text = ""
    if nominal is not None and series.perturbed is not None:
        text += f", {_perturbed(series, series.perturbed)}"
    return Statement(series.policy, " ".join([f"{text}.", *_costs(series)]))


def in_words(rate: Rate) -> str:
    """Return '198 of 200 (99 % [96, 100])'."""
    return f"{rate.successes} of {rate.n} ({rate.whole_percent})"


def _perturbed(series: Series, pooled: Rate) -> str:
    """Return the rate under the widest condition, or under all perturbed ones."""
    widest = widest_condition(series)
    if widest is None:
        return f"and in {in_words(pooled)} over {len(series.rates) - 1} perturbed conditions"
    cost = series.costs.get(widest)
    return f"and in {in_words(series.rates[widest])} under {widest}{_change(cost) if cost else ''}"


def widest_condition(series: Series) -> AxisCondition | None:
    """Return the condition with the most axes, then the highest levels, or the only perturbed one.

    None if there are several with one axis each.
    """
    perturbed = [each for each in series.records if each != NONE]
    several = [each for each in perturbed if len(each.ranges) > 1 or len(perturbed) == 1]
    return max(
        several, key=lambda each: (len(each.ranges), sum(high for *_, high in each.ranges)), default=None
    )


def _change(compared: PairedComparison) -> str:
    """Return ', 16 points less (p = 0.002)'."""
    test = format_p(compared.p_value)
    if compared.is_shown:
        return f", {_points(compared)} ({test})"
    return f" (no difference shown: {_points(compared)}, {test})"


def _points(compared: PairedComparison) -> str:
    difference = compared.counts.difference
    if difference == 0:
        return "no change"
    return f"{_num_points(difference)} {'less' if difference < 0 else 'more'}"


def _num_points(difference: float) -> str:
    return f"{100 * abs(difference):{points_format(difference)}} points"


def _costs(series: Series) -> Iterator[str]:
    """Yield sentences on what each condition costs beside the widest."""
    if not series.costs:
        if series.perturbed is not None:
            yield "What a condition costs is not known: no perturbed episode was also run unperturbed."
        return
    widest = widest_condition(series)
    of_axes = _worst_of_axes(series.costs.values(), () if widest is None else axes_of_condition(widest))
    shown = [each for each in of_axes if each.is_shown]
    lost = [each for each in shown if each.counts.difference < 0]
    won = [each for each in shown if each.counts.difference > 0]
    if lost:
        yield f"It loses most to {_named(lost)}."
    if won:
        yield f"It gains from {_named(won[::-1])}."
    others = [each for each in of_axes if not each.is_shown]
    if others:
        yield _no_difference(others, "other " if shown else "single " if widest else "")


def axes_of_condition(condition: AxisCondition) -> tuple[str, ...]:
    """Return the axes that a condition turns on."""
    return tuple(axis for axis, _, _ in condition.ranges)


def _worst_of_axes(costs: Iterable[PairedComparison], but: tuple[str, ...]) -> list[PairedComparison]:
    """Return one comparison for each set of axes but one: the largest loss that is shown, if any is."""
    by_axes: dict[tuple[str, ...], PairedComparison] = {}
    for each in costs:
        axes = axes_of_condition(each.pairs[0][1].spec.condition)
        known = by_axes.get(axes)
        if axes != but and (known is None or _strength(each) < _strength(known)):
            by_axes[axes] = each
    return sorted(by_axes.values(), key=lambda each: each.counts.difference)


def _strength(compared: PairedComparison) -> tuple[bool, float]:
    return not compared.is_shown, compared.counts.difference


def _named(costs: Sequence[PairedComparison]) -> str:
    """Return 'camera:3 (40 points less, p = 0.001) and light:3 (...)'."""
    names = [f"{each.condition} ({_points(each)}, {format_p(each.p_value)})" for each in costs]
    return in_a_row(first_of(names, MAX_NAMED))


def _no_difference(others: Sequence[PairedComparison], kind: str) -> str:
    """Say that conditions show no difference, and how many episodes the largest would take."""
    if len(others) == 1:
        subject = f"{others[0].condition} shows no difference"
    else:
        are_single = all(len(each.pairs[0][1].spec.condition.ranges) == 1 for each in others)
        subject = f"No {kind}{'axis' if are_single else 'condition'} shows a difference"
    likely = sorted(others, key=lambda each: each.counts.p_value)[:MAX_NAMED]
    needed = [(number, each) for each in likely if (number := each.num_needed)]
    if not needed:
        return f"{subject}."
    number, largest = min(needed, key=lambda found: found[0])
    name = "that" if len(others) == 1 else f"the largest, {largest.condition}"
    return f"{subject}; about {number:,} {_unit(largest)} would show {name} ({_points(largest)})."


def _unit(compared: PairedComparison) -> str:
    return "pairs of episodes" if compared.is_clustered else "seeds"


def describe_ranking(panel: Panel) -> Iterator[Statement]:
    """Say on which episodes policies are ranked, with their rates there, and why not where they are not."""
    kind, records = panel.shared
    suite = f" on {panel.name}" if panel.name else ""
    if not records:
        yield Statement(f"No ranking{suite}:", f"{_why_not_ranked(panel)}.")
        return
    rates = {each.policy: rate_of(shared) for each, shared in zip(panel.series, records, strict=True)}
    tied: dict[float, list[str]] = {}
    for each in panel.ranked:
        tied.setdefault(rates[each.policy].share, []).append(panel.short_names[each.policy])
    places = [
        f"{in_a_row(first_of(names, MAX_NAMED))} {'tie at ' if len(names) > 1 else ''}{100 * share:.0f} %"
        for share, names in tied.items()
    ]
    number = len(records[0])
    episodes = f"{number} {kind}episodes" if number > 1 else f"one {kind}episode"
    told = ", ".join(first_of(places, MAX_PLACES))
    yield Statement(f"Ranking{suite}", f"by the {episodes} that all policies have: {told}.")


def _why_not_ranked(panel: Panel) -> str:
    """Name the first two policies that have no episode in common."""
    specs = {each.policy: {record.spec for record in each.group.records} for each in panel.series}
    for first, second in combinations(specs, 2):
        if specs[first].isdisjoint(specs[second]):
            return f"{panel.short_names[first]} and {panel.short_names[second]} have no episode in common"
    return "no episode was run by all policies, though each two of them have some in common"


def describe_comparison(panel: Panel, first: Series, second: Series, compared: Comparisons) -> Statement:
    """Say which of two policies of a panel is better, and under which conditions."""
    settings = first.group.settings, second.group.settings
    found = [each for each in compared.conditions if tuple(map(settings_of, each.pairs[0])) == settings]
    nominal = [each for each in found if each.pairs[0][0].spec.perturbations == NONE]
    others = [each for each in found if each.pairs[0][0].spec.perturbations != NONE]
    names = panel.short_names[first.policy], panel.short_names[second.policy]
    parts = [f"unperturbed, {describe_verdict(each, *names)}." for each in nominal]
    if len(others) == 1:
        under = f"{'U' if parts else 'u'}nder {others[0].pairs[0][0].spec.perturbations}"
        parts.append(f"{under}, {describe_verdict(others[0], *names)}.")
    elif others:
        parts.append(_perturbed_verdict(others, *names))
    return Statement(f"{names[0]} against {names[1]}:", " ".join(parts) or "no episode of both.")


def _perturbed_verdict(found: Sequence[PairedComparison], first: str, second: str) -> str:
    """Say under how many perturbed conditions each is better."""
    shown = [each for each in found if each.is_shown]
    parts = []
    for name, sign in ((first, -1), (second, 1)):
        better = [each for each in shown if sign * each.counts.difference > 0]
        if better:
            most = max(better, key=lambda each: sign * each.counts.difference)
            condition = most.pairs[0][0].spec.perturbations
            points = _num_points(most.counts.difference)
            is_better = f"{name} is significantly better under {len(better)}"
            parts.append(f"{is_better}, most under {condition} (by {points})")
    told = in_a_row(parts) if parts else "none shows a significant difference"
    return f"Of {len(found):,} perturbed conditions, {told}."
