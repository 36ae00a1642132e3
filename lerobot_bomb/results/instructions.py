"""Instructions of episodes of `bomb`: their targets, and other instructions to exchange them for."""

from collections.abc import Sequence
from typing import Any

from lerobot_bomb.results.bomb import EpisodeResult


def named_targets(records: Sequence[EpisodeResult]) -> dict[str, Any]:
    """{instruction: its target}: in `place` the intersection; elsewhere it depends on the board."""
    return {
        each.instruction: each.target if each.spec.suite == "place" else each.instruction for each in records
    }


def other_instructions(records: Sequence[EpisodeResult]) -> dict[str, str]:
    """{instruction: another with another target}; {} if all have the same target."""
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
