"""Tables of benchmarks/pusht_offline.py: variants over seeds, and trivial predictors."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt
from statistics import fmean, stdev
from typing import Any

import numpy as np
from scipy.stats import t

from lerobot_bomb.bootstrap import bootstrap_interval
from lerobot_bomb.tables import print_table

SHOWN_STEPS = (1, 2, 3, 5, 8, 10, 12, 16)  # of the chunk
POLICY = "policy"


@dataclass(frozen=True)
class Seed:
    """One training: its validation column of `checkpoint offline-metrics`, time, coverages."""

    validation: dict[str, Any]
    minutes: float
    cpu_minutes: float
    max_coverages: list[float]  # of each episode in the environment, if it was run

    def l1(self, predictor: str = POLICY) -> float:
        """Held-out L1 in pixels."""
        return self.validation["l1"][predictor]["all"]["mean"]

    def l1_by_step(self, predictor: str = POLICY) -> list[float]:
        return [step["mean"] for step in self.validation["l1"][predictor]["steps"]]


def print_report(variants: dict[str, list[Seed]], recipe: str) -> bool:
    """Print the tables; return True if every seed of the recipe has a smaller L1 than all predictors."""
    rows = [
        [
            name,
            over_seeds([seed.l1() for seed in seeds]),
            f"{fmean(seed.minutes for seed in seeds):.1f}",
            f"{fmean(seed.cpu_minutes for seed in seeds):.1f}",
        ]
        for name, seeds in variants.items()
    ]
    print_table(["mean [95 % t over seeds]", "L1 held out, px", "minutes", "CPU min"], rows)
    _print_steps(variants)
    for number, seed in enumerate(variants.get(recipe, [])):
        if seed.max_coverages:
            print(f"pusht, seed {number}: mean maximal coverage {over_episodes(seed.max_coverages)}")
    return _is_beaten(variants.get(recipe, []))


def over_seeds(values: Sequence[float]) -> str:
    """Format the mean, with its t-interval if there are several values."""
    mean, precision = fmean(values), 3 if abs(fmean(values)) < 3 else 1
    if len(values) == 1:
        return f"{mean:.{precision}f}"
    half = t.ppf(0.975, len(values) - 1) * stdev(values) / sqrt(len(values))
    return f"{mean:.{precision}f} [{mean - half:.{precision}f}, {mean + half:.{precision}f}]"


def over_episodes(values: Sequence[float]) -> str:
    """Format the mean and its bootstrap interval."""
    interval = bootstrap_interval(np.array(values), np.ones(len(values)))
    text = "" if interval is None else f" [{interval[0]:.3f}, {interval[1]:.3f}]"
    return f"{fmean(values):.3f}{text} over {len(values)} episodes"


def _print_steps(variants: dict[str, list[Seed]]) -> None:
    """Print L1 by step of the chunk, of each variant (mean over seeds) and each trivial predictor."""
    first, *_ = next(iter(variants.values()))
    rows = {
        name: (fmean(seed.l1() for seed in seeds), np.mean([seed.l1_by_step() for seed in seeds], axis=0))
        for name, seeds in variants.items()
    }
    trivial = [name for name in first.validation["l1"] if name != POLICY]
    rows |= {name: (first.l1(name), np.array(first.l1_by_step(name))) for name in trivial}
    steps = [step for step in SHOWN_STEPS if step <= len(first.l1_by_step())]
    print("\nL1 held out, px, by step of the chunk")
    print_table(
        ["", "all", *map(str, steps)],
        [
            [name, f"{of_all:.1f}", *(f"{by[step - 1]:.1f}" for step in steps)]
            for name, (of_all, by) in rows.items()
        ],
    )


def _is_beaten(seeds: list[Seed]) -> bool:
    if not seeds:
        return True
    best = min((seeds[0].l1(name), name) for name in seeds[0].validation["l1"] if name != POLICY)
    worst_seed = max(seed.l1() for seed in seeds)
    verdict = "beaten by every seed" if worst_seed < best[0] else "NOT beaten by every seed"
    print(
        f"\nbest trivial predictor: {best[1]} with {best[0]:.1f} px, {verdict} (worst: {worst_seed:.1f} px)"
    )
    return worst_seed < best[0]
