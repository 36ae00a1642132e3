"""Evaluations that records belong to: how many of their episodes were run."""

from collections.abc import Sequence
from typing import Any

from lerobot_bomb.results.groups import groups_of, settings_of
from lerobot_bomb.results.record import Record, Spec

# settings in which the tasks of one evaluation may differ
PER_TASK = ("suite", "task_version")


def describe_missing_episodes(records: Sequence[Record]) -> str:
    """Return '7 of 20 episodes played' for evaluations that lack some; '' if, as far as recorded, none does.

    An evaluation no longer counts once later ones have run each of its episodes again.
    """
    kept = {_key(each) for group in groups_of(records) for each in group.records}
    played: dict[Any, set[Spec]] = {}
    for record in records:
        if (key := _key(record)) in kept:
            played.setdefault(key, set()).add(record.spec)
    counts = [
        f"{len(specs)} of {evaluation.num_episodes}"
        for (evaluation, *_), specs in played.items()
        if evaluation is not None and len(specs) < evaluation.num_episodes
    ]
    return f"{' and '.join(counts)} episodes played" if counts else ""


def _key(record: Record) -> tuple[Any, ...]:
    """Return a key that is equal for the records of one evaluation; its first part is the evaluation."""
    return record.evaluation, *(pair for pair in settings_of(record).items() if pair[0] not in PER_TASK)
