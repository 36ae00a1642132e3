"""Kinds of results, one for each environment; reading and comparing them is the same for all."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np

from lerobot_bomb.bootstrap import bootstrap_interval, format_bounds, sums_by
from lerobot_bomb.conditions import AxisCondition
from lerobot_bomb.data.environment import Environment
from lerobot_bomb.envs.results import Row
from lerobot_bomb.evaluation.line_checks import (
    SHARED_CHECKS,
    Check,
    check_fields,
    check_inference,
    check_levels,
    refuse_others,
)

NOT_RECORDED = "not recorded"
NO_VALUE = "-"  # of a measure that these episodes do not have
MAX_RUNS = 10  # of numbers, in a heading

type Pair = tuple[Row, Row]  # one episode unperturbed and perturbed, or of two policies


@dataclass(frozen=True)
class Measure:
    """A figure of episodes beside their rate of success."""

    name: str
    value: Callable[[list[Row]], str]  # with its unit
    note: str = ""  # what it is of


@dataclass(frozen=True)
class ResultKind:
    """Records of one environment: how they are known, what each must say, and what they say together."""

    env_type: str
    condition: type[AxisCondition]  # its perturbations
    # {protocol version: what its lines must say}, the oldest first; it is how lines are known, so no two
    # environments share one
    fields: Mapping[str, Mapping[str, Check]]
    spec_fields: dict[str, Check]
    # raises a ValueError unless there can be such an episode, whose fields are possible one by one
    check_episode: Callable[[Row], None]
    # what of a spec may differ between episodes that are pooled, beside seed and perturbations
    drawn: tuple[str, ...]
    # what must be equal in episodes that are pooled, beside spec, policy, protocol and size of images
    settings: Callable[[Row], dict[str, str]]
    # of these settings, what simulated and drew
    describe_simulator: Callable[[Mapping[str, str]], str]
    describe_tasks: Callable[[list[Row]], str]
    benchmark: Callable[[Row], str]  # for a model card, with its version
    # that an episode was played in; None: checkpoints of our types know of no such environment
    environment: Callable[[Row], Environment | None]
    eval_flags: Callable[[list[Row]], list[str]]  # of lerobot-eval, for the environment and tasks of episodes
    measures: Sequence[Measure]
    # what the second rows of pairs have beside other successes; '' where there is nothing to say
    describe_change: Callable[[list[Pair]], str] | None = None
    # of a spec, what lines of earlier releases do not have and then have by default
    added_spec_fields: Mapping[str, Check] = field(default_factory=dict)

    # what lines of earlier releases do not have
    added_fields: Mapping[str, Check] = field(default_factory=dict)
    tasks: Sequence[str] = ()  # values of --env.task
    has_results_path: bool = True  # lerobot-eval writes the lines, with --env.results_path
    # of a spec, what episodes have in common that start alike: they are not independent
    start: tuple[str, ...] = ("seed",)
    # an episode's number in its evaluation chooses how it starts, not its seed: in batches of one
    starts_by_number: bool = False

    def check(self, row: Row) -> None:
        """Raise a ValueError that names a field of a record which is missing or impossible."""
        of_later = {**self.added_fields, **SHARED_CHECKS}
        added = {name: check for name, check in of_later.items() if name in row}
        check_fields(row, {**self.fields[row["protocol_version"]], **added})

    def check_spec(self, row: Row) -> None:
        """Raise a ValueError unless a record is of an episode that there can be."""
        added = {name: check for name, check in self.added_spec_fields.items() if name in row["spec"]}
        check_fields(row["spec"], self.spec_fields | added, "spec.")
        refuse_others(row["spec"], self.spec_fields | added)
        self.check_episode(row)
        check_levels(row, self.condition)
        check_inference(row)

    def start_of(self, row: Row) -> tuple[Any, ...]:
        """Return a key that is equal for rows that are not independent."""
        return tuple(row["spec"][name] for name in self.start)

    def missing_fields(self, version: str) -> list[str]:
        """Return the fields that records of the newest protocol have and those of another version do not."""
        *_, newest = self.fields.values()
        return [name for name in newest if name not in self.fields[version]]


@lru_cache(maxsize=None, typed=True)
def json_list(*values: Any) -> str:
    """Return the JSON of hashable values as a list; each is written once, however many rows have it."""
    return json.dumps(values)


def mean_with_interval(rows: list[Row], name: str, start: tuple[str, ...] = ResultKind.start) -> str:
    """'0.440 [0.210, 0.670]' of a field: with a 95 % bootstrap interval over starts."""
    sums_E, counts_E = sums_by(
        np.array([row[name] for row in rows]), [tuple(row["spec"][of] for of in start) for row in rows]
    )
    mean = sums_E.sum() / counts_E.sum()
    return f"{mean:.3f}{format_bounds(bootstrap_interval(sums_E, counts_E), '.3f')}"


def describe_versions(row: Row) -> str:
    """'gym-pusht 0.1.8, pymunk 6.11.1': what the bits of an episode depend on."""
    versions = row["simulator_versions"].items()
    return ", ".join(f"{name} {version or '?'}" for name, version in versions)


def describe_numbers(numbers: Iterable[int]) -> str:
    """{0, 1, 2, 7} -> '0..2, 7'; of many runs, the first and the last number."""
    runs: list[list[int]] = []
    for number in sorted(set(numbers)):
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    if len(runs) > MAX_RUNS:
        return f"{runs[0][0]}..{runs[-1][-1]}, with gaps"
    return ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]}..{run[-1]}" for run in runs)
