"""What is wrong with a flag, said so that LeRobot's parser passes it on."""

from collections.abc import Collection, Iterator
from contextlib import contextmanager


class FlagError(Exception):
    """A config's flag has a value that is not allowed.

    Not a ValueError: LeRobot's parser replaces the text of a ValueError that a config raises.
    """


@contextmanager
def flag_errors() -> Iterator[None]:
    """Raise the ValueErrors of a config's checks as FlagError."""
    try:
        yield
    except ValueError as error:
        raise FlagError(str(error)) from None


def one_of(flag: str, value: object, allowed: Collection) -> None:
    """Raise a ValueError that names flag, value and choices unless value is allowed."""
    if value not in allowed:
        raise ValueError(f"{flag}={value!r} is unknown; choose one of: {', '.join(map(str, allowed))}")
