"""Parts of the decoding benchmarks: ways to write the same answers, timed in turn, and the verdict."""

import statistics
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from machine import write_figures
from torch import Tensor

from lerobot_bomb.tables import print_table


@dataclass(frozen=True)
class Timed:
    """One answer of each row."""

    numbers: Tensor  # (B, N)
    prefill_s: float
    decode_s: float
    num_passes: int  # the prompt's included


def compare(
    runs: dict[str, tuple[Callable[[Any], Timed], Sequence[Any]]], *, must_agree: bool = True
) -> dict[str, dict[str, float]]:
    """Time every way on every work, in turn, writing the same if they must. Gains are over the first."""
    timed: dict[str, list[Timed]] = {name: [] for name in runs}
    for run, works in runs.values():
        run(works[0])
    for i in range(max(len(works) for _, works in runs.values())):
        for name, (run, works) in runs.items():
            timed[name].append(run(works[i]))
        expected, *others = (answers[-1].numbers for answers in timed.values())
        if must_agree and not all(
            torch.equal(numbers, expected[:, : numbers.shape[1]]) for numbers in others
        ):
            raise SystemExit(f"answer {i}: {', '.join(runs)} do not write the same numbers")
    figures = {
        name: {
            "prefill_ms": 1e3 * statistics.median(answer.prefill_s for answer in answers),
            "decode_ms": 1e3 * statistics.median(answer.decode_s for answer in answers),
            "passes": statistics.mean(answer.num_passes for answer in answers),
            "whole_ms": 1e3 * statistics.median(answer.prefill_s + answer.decode_s for answer in answers),
        }
        for name, answers in timed.items()
    }
    slowest, *_ = figures.values()
    for row in figures.values():
        row["decode_gain"] = slowest["decode_ms"] / row["decode_ms"]
        row["whole_gain"] = slowest["whole_ms"] / row["whole_ms"]
    return figures


def print_rows(title: str, figures: dict[str, dict[str, float]]) -> None:
    """Print a table of rows of figures."""
    print()
    header = next(iter(figures.values()))
    print_table(
        [title, *(name.replace("_", " ") for name in header)],
        [[name, *(f"{value:.2f}" for value in row.values())] for name, row in figures.items()],
    )


def finish(path: Path | None, figures: dict[str, Any], bars: dict[str, bool]) -> None:
    """Print which bars hold, write the figures, leave; exit code 1 where a bar is missed."""
    print("\n".join(f"{'ok' if holds else 'MISSED'}: {bar}" for bar, holds in bars.items()))
    write_figures(path, {**figures, "bars": bars})
    sys.exit(0 if all(bars.values()) else 1)
