"""Failure classes of episodes, each with its meaning."""

from enum import StrEnum
from typing import Self


class FailureClass(StrEnum):
    """Enum of failure classes, each with a value, which records hold, and a meaning."""

    meaning: str  # completes "the episode ended with"

    def __new__(cls, value: str, meaning: str) -> Self:
        member = str.__new__(cls, value)
        member._value_, member.meaning = value, meaning
        return member
