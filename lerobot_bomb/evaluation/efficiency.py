"""Latency and smoothness of a policy, from records of results that hold them."""

from dataclasses import dataclass
from statistics import median

import numpy as np

from lerobot_bomb.bootstrap import Measure, bootstrap_interval, sums_by
from lerobot_bomb.envs.results import Row
from lerobot_bomb.evaluation.result_groups import starts_of


@dataclass(frozen=True)
class Efficiency:
    """Efficiency in episodes of one policy that were run in batches of one size, on one device."""

    device: str
    batch_size: int | None  # episodes that a query answers at once; None: not recorded
    num_queries: int
    latency_p50_ms: float  # medians over episodes
    latency_p95_ms: float
    actions_per_s: float  # that are executed in an episode, by second of its queries
    passes: float | None  # means over all queries
    tokens: float | None
    num_parameters: int
    peak_memory_bytes: int | None  # the largest


def efficiencies(rows: list[Row]) -> list[Efficiency]:
    """Measure the efficiency of the records that hold it, by device and size of the batch."""
    groups: dict[tuple[str, int | None], list[Row]] = {}
    for row in rows:
        if row.get("inference") is not None:
            batch_size = (row.get("policy") or {}).get("batch_size")
            groups.setdefault((row["inference"]["device"], batch_size), []).append(row)
    return [_efficiency(*key, of) for key, of in groups.items()]


def smoothness_of(rows: list[Row]) -> dict[str, Measure]:
    """{"J2": ..., "J3": ...}: every difference of every episode counts the same; {} where no row says it."""
    told = [row for row in rows if row.get("action_j2") is not None and row.get("action_j3") is not None]
    return {f"J{order}": _mean_difference(told, order) for order in (2, 3)} if told else {}


def _mean_difference(rows: list[Row], order: int) -> Measure:
    counts_N = np.array([row["steps"] - order for row in rows])
    starts = starts_of(rows)
    sums_E, _ = sums_by(counts_N * np.array([row[f"action_j{order}"] for row in rows]), starts)
    counts_E, _ = sums_by(counts_N, starts)
    interval = bootstrap_interval(sums_E, counts_E) or (None, None)
    return Measure(float(sums_E.sum() / counts_E.sum()), *interval)


def lines(rows: list[Row]) -> list[tuple[str, str, str]]:
    """(name, value, note) of each figure that the rows have."""
    found = [
        ("latency", f"{each.latency_p50_ms:.3g} ms, p95 {each.latency_p95_ms:.3g} ms", _note(each))
        for each in efficiencies(rows)
    ]
    smooth = smoothness_of(rows)
    if smooth:
        value = ", ".join(f"{name} {of}" for name, of in smooth.items())
        found.append(("smoothness", value, "of the executed actions, per step; less is smoother"))
    return found


def _note(of: Efficiency) -> str:
    batch = "" if of.batch_size is None else f" for {of.batch_size} at once"
    return f"of a query{batch}, median over episodes; {of.device}"


def _efficiency(device: str, batch_size: int | None, rows: list[Row]) -> Efficiency:
    told = [row["inference"] for row in rows]
    queries = [each["num_queries"] for each in told]

    def mean(name: str) -> float | None:
        parts = [(of[name], number) for of, number in zip(told, queries, strict=True) if of[name] is not None]
        return sum(of * n for of, n in parts) / sum(n for _, n in parts) if parts else None

    return Efficiency(
        device=device,
        batch_size=batch_size,
        num_queries=sum(queries),
        latency_p50_ms=median(each["latency_p50_ms"] for each in told),
        latency_p95_ms=median(each["latency_p95_ms"] for each in told),
        actions_per_s=sum(row["steps"] for row in rows) / sum(each["total_s"] for each in told),
        passes=mean("passes"),
        tokens=mean("tokens"),
        num_parameters=told[-1]["num_parameters"],
        peak_memory_bytes=max(each["peak_memory_bytes"] or 0 for each in told) or None,
    )
