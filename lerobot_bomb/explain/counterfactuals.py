"""Counterfactuals of a failed episode: the same seed without some of its perturbations."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from lerobot_bomb.conditions import NONE
from lerobot_bomb.explain.film import EpisodeRun
from lerobot_bomb.explain.masked_episodes import Mask, run_under
from lerobot_bomb.viewing.checkpoint import LoadedPolicy
from lerobot_bomb.viewing.episode import Viewed


@dataclass(frozen=True)
class Counterfactual:
    """Run of an episode's seed without some of its perturbation axes."""

    without: tuple[str, ...]  # axes
    perturbations: str  # condition that is left
    run: EpisodeRun

    @property
    def name(self) -> str:
        """Name for people: "without object"."""
        return "unperturbed" if self.perturbations == NONE else f"without {', '.join(self.without)}"

    def as_json(self) -> dict[str, Any]:
        """Return the counterfactual as JSON values."""
        return {
            "without": list(self.without),
            "perturbations": self.perturbations,
            "result": self.run.result.as_json(),
            **self.run.paths,
        }


def conditions_without(levels: Mapping[str, int]) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield (axes taken away, condition that is left): each axis alone, then all of them.

    ``levels``: of the axes that were on, as drawn; an axis draws the same whichever others are on.
    """
    on = {axis: level for axis, level in levels.items() if level}
    for axis in on if len(on) > 1 else ():
        left = [f"{each}:{level}" for each, level in on.items() if each != axis]
        yield (axis,), "+".join(left)
    if on:
        yield tuple(on), NONE


def run_counterfactuals(
    result: Any, viewed: Callable[[str], Viewed], loaded: LoadedPolicy
) -> list[Counterfactual]:
    """Run a failed episode again without its perturbations; [] of a success, or of an unperturbed one.

    ``viewed``: the episode of the same seed under other perturbations.
    """
    if result.is_success:
        return []
    return [
        Counterfactual(without, condition, run_under(viewed(condition), loaded, Mask(), with_film=True))
        for without, condition in conditions_without(result.levels)
    ]


def settled_by(counterfactuals: Sequence[Counterfactual]) -> Counterfactual | None:
    """Return the one that says most: a success under most perturbations, or the unperturbed one."""
    by_size = sorted(counterfactuals, key=lambda each: len(each.without))
    successes = [each for each in by_size if each.run.result.is_success]
    return next(iter(successes), by_size[-1] if by_size else None)
