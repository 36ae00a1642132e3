"""Smoothness of people's and policies' motions, side by side.

Shapes: `R` executed actions of all episodes, `D` action dims, `E` episodes.
"""

import sys
from dataclasses import dataclass

import numpy as np

from lerobot_bomb.bootstrap import Estimate, paired_bootstrap_interval
from lerobot_bomb.evaluation.executed import ActionLog, start_of
from lerobot_bomb.smoothness import MIN_ACTIONS, smoothness
from lerobot_bomb.stats import sums_by
from lerobot_bomb.tables import print_table

GRIPPER = "gripper"  # in the names of dims that do not count
ORDERS = {"J2": 2, "J3": 3, "J2, normalised": 2, "J3, normalised": 3}  # of the differences


@dataclass(frozen=True)
class Units:
    """Units in which everything that is compared is measured."""

    exclude: list[int]  # dims that do not count
    std: np.ndarray  # (D,) standard deviations, which are 1 in normalised units
    per_second: bool  # per s^2 and s^3 instead of per step


@dataclass(frozen=True)
class SmoothnessRow:
    """The smoothness of a dataset or an evaluation; every dict has the keys of ORDERS."""

    fps: float
    num_skipped: int  # episodes that are too short
    num_actions: dict[str, int]  # of each episode
    measures: dict[str, Estimate]  # of all episodes
    episodes: dict[str, dict[str, float]]  # measures of each


@dataclass(frozen=True)
class Difference:
    """Difference in smoothness between two evaluations, on the episodes that both have."""

    num_pairs: int
    measures: dict[str, Estimate]


def make_units(dataset: ActionLog, names: list[str], exclude: list[str] | None, per_second: bool) -> Units:
    """Return the units of a dataset.

    Raises:
        ValueError: a name in `exclude` is unknown, no dim is left, or one of those left never changes.
    """
    if exclude is None:
        exclude = [name for name in names if GRIPPER in name.lower()]
    if unknown := [name for name in exclude if name not in names]:
        raise ValueError(f"--exclude={','.join(exclude)}: no action dim {unknown[0]!r}; there are {names}")
    std_D = np.concatenate(list(dataset.episodes.values())).astype(np.float64).std(axis=0)
    left = [name for name in names if name not in exclude]
    if not left:
        raise ValueError(f"--exclude={','.join(exclude)} leaves none of the action dims {names}")
    if constant := [name for name, std in zip(names, std_D, strict=True) if name in left and std == 0]:
        raise ValueError(
            f"{dataset.name}: the action dim {constant[0]!r} never changes, so that it has no normalised "
            f"unit; leave it out with --exclude={','.join([*exclude, *constant])}"
        )
    return Units([names.index(name) for name in exclude], std_D, per_second)


def check_comparable(compared: list[ActionLog], per_second: bool) -> None:
    """Raise a ValueError unless each is named once and all have as many dims; warn if their rates differ."""
    dataset, *others = compared
    names = [executed.name for executed in compared]
    if doubled := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"{doubled[0]} is named twice")
    for executed in others:
        if executed.num_dims != dataset.num_dims:
            raise ValueError(
                f"{executed.name}: actions have {executed.num_dims} dims, those of {dataset.name} "
                f"{dataset.num_dims}"
            )
        if executed.fps != dataset.fps and not per_second:
            print(
                f"warning: {executed.name} has {executed.fps:g} actions a second, {dataset.name} "
                f"{dataset.fps:g}: differences per step do not compare, those of --per_second do",
                file=sys.stderr,
            )


def measure_row(executed: ActionLog, units: Units) -> SmoothnessRow:
    """Measure the smoothness of a row; every difference within an episode counts the same.

    Raises:
        ValueError: no episode has enough actions for a third difference.
    """
    episodes = {
        name: actions_TD for name, actions_TD in executed.episodes.items() if len(actions_TD) >= MIN_ACTIONS
    }
    if not episodes:
        raise ValueError(f"{executed.name}: no episode has {MIN_ACTIONS} actions")
    num_actions = {name: len(actions_TD) for name, actions_TD in episodes.items()}
    actions_RD = np.concatenate(list(episodes.values()))
    episode_R = np.repeat(np.arange(len(episodes)), list(num_actions.values()))
    places = {start: place for place, start in enumerate(dict.fromkeys(map(start_of, episodes)))}
    start_R = np.repeat([places[start_of(name)] for name in episodes], list(num_actions.values()))
    dt_s = 1 / executed.fps if units.per_second else None
    return SmoothnessRow(
        executed.fps,
        len(executed.episodes) - len(episodes),
        num_actions,
        _measures(actions_RD, episode_R, start_R, units, dt_s),
        {
            name: {
                key: estimate.mean
                for key, estimate in _measures(actions_TD, zeros, zeros, units, dt_s).items()
            }
            for name, actions_TD in episodes.items()
            for zeros in [np.zeros(len(actions_TD))]
        },
    )


def _measures(
    actions_RD: np.ndarray, episode_R: np.ndarray, start_R: np.ndarray, units: Units, dt_s: float | None
) -> dict[str, Estimate]:
    options = {"start_R": start_R, "exclude": units.exclude, "dt_s": dt_s}
    raw = smoothness(actions_RD, episode_R, **options)
    normalised = smoothness(actions_RD, episode_R, std_D=units.std, **options)
    return dict(zip(ORDERS, (raw.j2, raw.j3, normalised.j2, normalised.j3), strict=True))


def measure_difference(first: str, second: str, rows: dict[str, SmoothnessRow]) -> Difference:
    """Subtract the first row's means from the second's; the bootstrap draws pairs of one seed together.

    Raises:
        ValueError: they have no episode in common.
    """
    pairs = [name for name in rows[first].episodes if name in rows[second].episodes]
    if not pairs:
        raise ValueError(f"{first} and {second} have no episode of the same group, task and seed")
    starts = list(map(start_of, pairs))
    measures = {}
    for key, order in ORDERS.items():
        both = []
        for row in (rows[first], rows[second]):
            counts_N = np.array([row.num_actions[name] - order for name in pairs])
            sums_E, _ = sums_by(counts_N * [row.episodes[name][key] for name in pairs], starts)
            both.append((sums_E, sums_by(counts_N, starts)[0]))
        before, after = (sums_E.sum() / counts_E.sum() for sums_E, counts_E in both)
        interval = paired_bootstrap_interval(*both)
        measures[key] = Estimate(float(after - before), *(interval or (None, None)))
    return Difference(len(pairs), measures)


def print_rows(rows: dict[str, SmoothnessRow]) -> None:
    """Print a row per dataset or evaluation."""
    cells = [
        [name, str(len(row.episodes)), str(sum(row.num_actions.values())), *map(str, row.measures.values())]
        for name, row in rows.items()
    ]
    print_table(["", "episodes", "actions", *ORDERS], cells)
    for name, row in rows.items():
        if row.num_skipped:
            print(f"{name}: {row.num_skipped} more with fewer than {MIN_ACTIONS} actions do not count")


def print_differences(first: str, differences: dict[str, Difference]) -> None:
    """Print a row per evaluation that was compared with the first."""
    print(f"\nDifference from {first} on the same episodes")
    cells = [
        [name, str(difference.num_pairs), *map(str, difference.measures.values())]
        for name, difference in differences.items()
    ]
    print_table(["", "pairs", *ORDERS], cells)
