"""Latency and smoothness of a policy, from records that hold them."""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np

from lerobot_bomb.bootstrap import Estimate
from lerobot_bomb.results.inference import Inference
from lerobot_bomb.results.record import Record
from lerobot_bomb.stats import sums_by


@dataclass(frozen=True)
class Efficiency:
    """Efficiency in episodes of one policy that were run in batches of one size, on one device."""

    device: str
    batch_size: int | None  # episodes that a query answers at once; None: not recorded
    num_queries: int
    latency_p50_ms: float  # medians over episodes
    latency_p95_ms: float
    actions_per_s: float  # executed in an episode, per second of its queries
    passes: float | None  # means over all queries
    tokens: float | None
    num_parameters: int
    peak_memory_bytes: int | None  # the largest


def efficiencies(records: Sequence[Record]) -> list[Efficiency]:
    """Measure the efficiency of the records that hold it, by device and size of the batch."""
    groups: dict[tuple[str, int | None], list[tuple[Record, Inference]]] = {}
    for record in records:
        if record.inference is not None:
            batch_size = None if record.policy is None else record.policy.batch_size
            measured = groups.setdefault((record.inference.device, batch_size), [])
            measured.append((record, record.inference))
    return [_efficiency(*key, measured) for key, measured in groups.items()]


def smoothness_of(records: Sequence[Record]) -> dict[str, Estimate]:
    """Return {"J2": ..., "J3": ...}, each difference with equal weight; {} if no record has them."""
    told = [each for each in records if each.action_j2 is not None and each.action_j3 is not None]
    return {f"J{order}": _mean_difference(told, order) for order in (2, 3)} if told else {}


def _mean_difference(records: Sequence[Any], order: int) -> Estimate:
    counts_N = np.array([each.steps - order for each in records])
    starts = [each.start_key for each in records]
    sums_E, _ = sums_by(counts_N * np.array([getattr(each, f"action_j{order}") for each in records]), starts)
    counts_E, _ = sums_by(counts_N, starts)
    return Estimate.of(sums_E, counts_E)


def lines(records: Sequence[Record]) -> list[tuple[str, str, str]]:
    """Return (name, value, note) of each figure that the records have."""
    found = [
        ("latency", f"{each.latency_p50_ms:.3g} ms, p95 {each.latency_p95_ms:.3g} ms", _note(each))
        for each in efficiencies(records)
    ]
    smooth = smoothness_of(records)
    if smooth:
        value = ", ".join(f"{name} {estimate}" for name, estimate in smooth.items())
        found.append(("smoothness", value, "of the executed actions, per step; less is smoother"))
    return found


def _note(efficiency: Efficiency) -> str:
    batch = "" if efficiency.batch_size is None else f" for {efficiency.batch_size} at once"
    return f"of a query{batch}, median over episodes; {efficiency.device}"


def _efficiency(device: str, batch_size: int | None, measured: Sequence[tuple[Any, Inference]]) -> Efficiency:
    told = [inference for _, inference in measured]

    def mean(name: str) -> float | None:
        parts = [(value, each.num_queries) for each in told if (value := getattr(each, name)) is not None]
        return sum(value * n for value, n in parts) / sum(n for _, n in parts) if parts else None

    return Efficiency(
        device=device,
        batch_size=batch_size,
        num_queries=sum(each.num_queries for each in told),
        latency_p50_ms=median(each.latency_p50_ms for each in told),
        latency_p95_ms=median(each.latency_p95_ms for each in told),
        actions_per_s=sum(record.steps for record, _ in measured) / sum(each.total_s for each in told),
        passes=mean("passes"),
        tokens=mean("tokens"),
        num_parameters=told[-1].num_parameters,
        peak_memory_bytes=max(each.peak_memory_bytes or 0 for each in told) or None,
    )
