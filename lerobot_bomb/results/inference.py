"""Latency of a policy: measured in its process, written to the records of its episodes.

Simulator workers import this module, so it imports neither torch nor LeRobot.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_bomb.results.schema import Count, Positive, Quantity


@dataclass(frozen=True)
class Query:
    """A call of `select_action` that ran the network, once for all episodes of a batch."""

    seconds: float  # until the actions are there
    passes: int | None  # of the network, the prompt's included; None: this policy does not tell
    tokens: float | None  # generated for one episode; None: not told, or none generated
    num_parameters: int
    peak_memory_bytes: int | None  # since the policy was first asked; None: this system does not tell
    device: str


@dataclass(frozen=True)
class Inference:
    """Queries of an episode, and the device that ran them."""

    num_queries: Count  # queries of the episode: calls that ran the network
    total_s: Positive  # seconds of all queries
    # median latency of a query in ms; a query serves all episodes of the batch
    latency_p50_ms: Positive
    latency_p95_ms: Positive  # 95th percentile of the same
    # forward passes per query, mean, prompt and sampling steps included; null: unknown
    passes: Quantity | None
    # tokens generated per query for one episode, mean; null: none or unknown
    tokens: Quantity | None
    num_parameters: Count  # parameters of the policy
    # largest memory in use; on CUDA of tensors, on a CPU of the whole process; null: unknown
    peak_memory_bytes: Count | None
    device: str  # the GPU's name, or cpu with its number of threads

    @classmethod
    def of(cls, queries: Sequence[Query]) -> "Inference | None":
        """Summarise the queries; None without any: the policy has no network, or was not measured."""
        if not queries:
            return None
        seconds = np.array([query.seconds for query in queries])
        p50_ms, p95_ms = (1000 * np.percentile(seconds, [50, 95])).tolist()
        last = queries[-1]
        return cls(
            num_queries=len(queries),
            total_s=float(seconds.sum()),
            latency_p50_ms=p50_ms,
            latency_p95_ms=p95_ms,
            passes=_mean([query.passes for query in queries]),
            tokens=_mean([query.tokens for query in queries]),
            num_parameters=last.num_parameters,
            peak_memory_bytes=last.peak_memory_bytes,
            device=last.device,
        )


def _mean(values: Sequence[float | None]) -> float | None:
    told = [value for value in values if value is not None]
    return sum(told) / len(told) if told else None
