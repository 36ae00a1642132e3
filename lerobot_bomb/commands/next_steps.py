"""Commands that a user may want next."""

from collections.abc import Mapping

from lerobot_bomb.tables import print_lines


def print_next(steps: Mapping[str, str]) -> None:
    """Print commands to be copied, each with what it is for: {command: purpose}."""
    width = max(map(len, steps), default=0)
    print_lines("", "next:", *(f"  {command:<{width}}  # {purpose}" for command, purpose in steps.items()))
