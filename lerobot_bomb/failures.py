"""Failure classes of episodes, each with its meaning."""

from enum import StrEnum
from typing import Self


class FailureClass(StrEnum):
    """Reason why an episode failed; exactly one per failed episode."""

    meaning: str  # completes "the episode ended with"

    def __new__(cls, value: str, meaning: str) -> Self:
        member = str.__new__(cls, value)
        member._value_, member.meaning = value, meaning
        return member
