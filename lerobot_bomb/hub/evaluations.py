"""Evaluations in the Hub's own formats: a model card's `model-index`, and `.eval_results/*.yaml`."""

from collections.abc import Iterable, Iterator
from typing import Any

import yaml
from huggingface_hub import EvalResult, EvalResultEntry, eval_result_entries_to_yaml
from huggingface_hub.repocard_data import eval_results_to_model_index

from lerobot_bomb.conditions import AxisCondition
from lerobot_bomb.results.comparison import kept_apart
from lerobot_bomb.results.groups import (
    Group,
    by_condition,
    condition_key,
    differing,
    rate_of,
    suite_or_task,
)
from lerobot_bomb.results.record import Record

METRIC = "success_rate"  # a share, 0..1


def model_index(groups: list[Group]) -> list[EvalResult]:
    """Return success rates by condition, for the metadata of a model card."""
    return [
        EvalResult(
            task_type="robotics",
            task_name=suite_or_task(records[0]),
            dataset_type=group.record_type.env_type,
            dataset_name=group.records[0].benchmark(),
            # tells results apart, which their task does not
            dataset_config=condition_key(records[0], condition),
            metric_type=METRIC,
            metric_name="success rate",
            metric_value=_share(records),
            metric_args=_count_of(records),
        )
        for group, condition, records in _conditions(groups)
    ]


def model_index_yaml(model_name: str, groups: list[Group]) -> str:
    """Write `model_index` as YAML: the key `model-index` of a model card's metadata."""
    index = eval_results_to_model_index(model_name, model_index(groups))
    return as_yaml({"model-index": index})


def eval_results_yaml(benchmark_id: str, groups: list[Group]) -> str:
    """Write a file of `.eval_results`; `benchmark_id` is the benchmark's dataset on the Hub."""
    entries = [
        EvalResultEntry(
            dataset_id=benchmark_id,
            task_id=condition_key(records[0], condition),
            value=_share(records),
            notes=f"{_counted(records)}; {group.lines()[1]}",
        )
        for group, condition, records in _conditions(groups)
    ]
    return as_yaml(eval_result_entries_to_yaml(entries))


def task_ids_of(groups: Iterable[Group]) -> list[str]:
    """Return the names of suites under conditions, as `place.camera-3`, each once."""
    return [
        *dict.fromkeys(condition_key(records[0], condition) for _, condition, records in _conditions(groups))
    ]


def check_one_rate_each(groups: list[Group]) -> None:
    """Raise a ValueError if a policy has two rates for one condition, of episodes that must not be pooled."""
    first: dict[tuple[str, AxisCondition], Group] = {}
    for group, condition, records in _conditions(groups):
        other = first.setdefault((suite_or_task(records[0]), condition), group)
        if other is not group:
            raise ValueError(
                f"{records[0].describe_policy()} has two rates for {suite_or_task(records[0])}, {condition}: "
                f"the episodes differ in {', '.join(differing([other, group]))}; export the records of one"
            )


def check_policies_compare(groups: Iterable[Group]) -> None:
    """Raise a ValueError if policies have rates of one name, of episodes that must not be compared."""
    earlier: dict[str, list[Group]] = {}
    for group, condition, records in _conditions(groups):
        name = condition_key(records[0], condition)
        others = earlier.setdefault(name, [])
        for other in others:
            if apart := kept_apart(other, group):
                raise ValueError(
                    f"{name} of {other.policy} and {group.policy} must not be compared: the episodes differ "
                    f"in {', '.join(apart)}; export each by itself, to its own --output"
                )
        others.append(group)


def _conditions(groups: Iterable[Group]) -> Iterator[tuple[Group, AxisCondition, list[Record]]]:
    for group in groups:
        for condition, records in by_condition(group.records).items():
            yield group, condition, records


def _share(records: list[Record]) -> float:
    return rate_of(records).share


def _count_of(records: list[Record]) -> dict[str, Any]:
    """Return what a rate is of: successes, episodes, and the interval's bounds and method."""
    rate = rate_of(records)
    interval = None if rate.interval is None else [round(bound, 4) for bound in rate.interval]
    return {"successes": rate.successes, "episodes": rate.n, "interval": interval, "method": rate.method}


def _counted(records: list[Record]) -> str:
    return str(rate_of(records))


def as_yaml(values: Any) -> str:
    """Write values as YAML, a line each."""
    return yaml.safe_dump(values, sort_keys=False, allow_unicode=True, width=1000)
