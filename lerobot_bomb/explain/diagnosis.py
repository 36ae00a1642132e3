"""Diagnosis of one moment, in words: what the policy's answer depends on."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

from lerobot_bomb.explain.limits import ALL, RESTORES, SHARE, smallest_drop
from lerobot_bomb.explain.moment import Explanation
from lerobot_bomb.explain.moment_query import camera_name
from lerobot_bomb.explain.patching import PatchingResult

MAX_NAMES = 6  # that are shown


@dataclass(frozen=True)
class Finding:
    """A question and its answer."""

    question: str
    answer: str
    names: tuple[str, ...]  # what the answer names

    @classmethod
    def of_effects(cls, question: str, effects: Mapping[str, float], *, is_weak: bool) -> Self:
        """Name the parts with an effect, the largest first, at most a few.

        ``is_weak``: the largest is below a SHARE of the largest effect of any kind.
        """
        shown = [f"{name} ({effect:.2g})" for name, effect in effects.items()]
        more = len(shown) - MAX_NAMES
        names = "; ".join(shown[:MAX_NAMES]) + (f" and {more} more" if more > 0 else "") or "nothing"
        return cls(question, f"weakly, {names}" if is_weak and shown else names, tuple(effects))

    def __str__(self) -> str:
        return f"{self.question} {self.answer}"


def diagnose(explanation: Explanation) -> list[Finding]:
    """Return the findings on an explained moment, question by question."""
    patches = {
        f"{camera_name(key)} patch {line}, {column}": float(map_GG[line, column])
        for key, map_GG in explanation.patches.items()
        for line in range(len(map_GG))
        for column in range(len(map_GG))
    }
    kinds = {"Patches": patches}
    if explanation.objects:
        kinds["Objects"] = explanation.objects[ALL]
    if explanation.words:
        kinds["Hidden words"] = explanation.words
    if explanation.others:
        kinds["Changed words"] = explanation.others
    weak = SHARE * max(map(_largest, kinds.values()))
    findings = [
        Finding.of_effects(
            f"{kind} that the answer depends on:",
            used(effects, explanation.clean_score),
            is_weak=_largest(effects) < weak,
        )
        for kind, effects in kinds.items()
    ]
    findings += [
        Finding.of_effects(
            f"Heads that alone restore it, {result.corruption}:",
            _heads(result),
            is_weak=abs(result.drop) < weak,
        )
        for result in explanation.restored
    ]
    return findings


def used(effects: Mapping[str, float], clean_score: float) -> dict[str, float]:
    """Return effects that are more than rounding and a SHARE of the largest, the largest first."""
    smallest = max(smallest_drop(clean_score), SHARE * _largest(effects))
    found = {name: effect for name, effect in effects.items() if abs(effect) > smallest}
    return dict(sorted(found.items(), key=lambda pair: -abs(pair[1])))


def _largest(effects: Mapping[str, float]) -> float:
    return max(map(abs, effects.values()), default=0.0)


def _heads(result: PatchingResult) -> dict[str, float]:
    ratios = {
        f"layer {layer}, head {head}": ratio
        for layer, of_layer in enumerate(result.heads)
        for head, ratio in enumerate(of_layer)
    }
    found = {name: ratio for name, ratio in ratios.items() if ratio >= RESTORES}  # NaN is not
    return dict(sorted(found.items(), key=lambda pair: -pair[1]))
