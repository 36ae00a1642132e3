"""What an explanation of one moment says, in words: what the policy's answer depends on."""

from collections.abc import Mapping
from dataclasses import dataclass

from lerobot_bomb.explain.moment import Explanation, Restored, camera_name
from lerobot_bomb.explain.restoration import smallest_drop

SHARE = 0.05  # an effect below this share of the largest of its kind is none
MAX_NAMES = 6  # that are shown
RESTORES = 0.5  # what a head alone must bring back to be named


@dataclass(frozen=True)
class Finding:
    """A question and its answer; names in order of their effects, the largest first."""

    question: str
    names: tuple[str, ...]  # () where there is nothing

    @property
    def answer(self) -> str:
        """The names, as many as one reads."""
        more = len(self.names) - MAX_NAMES
        return "; ".join(self.names[:MAX_NAMES]) + (f" and {more} more" if more > 0 else "") or "none"

    def __str__(self) -> str:
        return f"{self.question} {self.answer}"


def diagnose(explanation: Explanation) -> list[Finding]:
    """What was found, question by question."""
    clean = explanation.clean_score
    patches = {
        f"{camera_name(key)} line {line}, column {column}": float(map_GG[line, column])
        for key, map_GG in explanation.patches.items()
        for line in range(len(map_GG))
        for column in range(len(map_GG))
    }
    findings = [Finding("Patches that the answer depends on:", used(patches, clean))]
    for key, effects in explanation.objects.items():
        findings.append(Finding(f"Objects that it depends on, {camera_name(key)}:", used(effects, clean)))
    if explanation.words:
        findings.append(Finding("Words that it depends on, hidden:", used(explanation.words, clean)))
    if explanation.others:
        findings.append(Finding("Words that it depends on, changed:", used(explanation.others, clean)))
    for restored in explanation.restored:
        findings.append(
            Finding(f"Heads that alone restore the answer, {restored.corruption}:", _heads(restored))
        )
    return findings


def used(effects: Mapping[str, float], clean_score: float) -> tuple[str, ...]:
    """Names of effects that are more than rounding and more than a SHARE of the largest."""
    largest = max((abs(effect) for effect in effects.values()), default=0.0)
    smallest = max(smallest_drop(clean_score), SHARE * largest)
    found = [name for name, effect in effects.items() if abs(effect) > smallest]
    return tuple(sorted(found, key=lambda name: -abs(effects[name])))


def _heads(restored: Restored) -> tuple[str, ...]:
    ratios = {
        f"layer {layer}, head {head}": ratio
        for layer, of_layer in enumerate(restored.heads)
        for head, ratio in enumerate(of_layer)
    }
    found = [name for name, ratio in ratios.items() if ratio >= RESTORES]  # NaN is not
    return tuple(sorted(found, key=lambda name: -ratios[name]))
