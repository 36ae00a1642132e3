"""Instructions of episodes of `bomb`: their targets, and other instructions to exchange them for."""

from collections.abc import Sequence
from typing import Any

from lerobot_bomb.results.bomb import EpisodeResult


def named_targets(records: Sequence[EpisodeResult]) -> dict[str, Any]:
    """Return {instruction: its target}: an intersection in `place`; elsewhere the instruction itself."""
    return {
        each.instruction: each.target if each.spec.suite == "place" else each.instruction for each in records
    }


def other_instructions(records: Sequence[EpisodeResult]) -> dict[str, str]:
    """Return {instruction: another one, mostly with another target}; {} if all targets are the same."""
    targets = named_targets(records)
    first, *others = targets.values()
    if all(other == first for other in others):
        return {}
    instructions = sorted(targets)

    def shifted(places: int) -> dict[str, str]:
        return dict(zip(instructions, instructions[places:] + instructions[:places], strict=True))

    def num_others(given: dict[str, str]) -> int:
        return sum(targets[instruction] != targets[other] for instruction, other in given.items())

    return max(map(shifted, range(1, len(instructions))), key=num_others)
