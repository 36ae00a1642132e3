"""What is wrong with a config, said so that LeRobot's parser passes it on."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NoReturn

from draccus.utils import DecodingError


class FlagError(DecodingError):
    """A config's flag has a value that is not allowed.

    LeRobot's commands print such an error in one line, whether the value came from a flag or a file. Of a
    ValueError that a config raises, their parser drops the text.
    """

    def __init__(self, message: str) -> None:
        super().__init__((), message)

    def strip_prefix(self, prefix: Sequence[str]) -> NoReturn:
        """Draccus asks for it to list what is wrong for every type of a union: a flag is told alone."""
        raise self


@contextmanager
def flag_errors() -> Iterator[None]:
    """Raise the ValueErrors of a config's checks as FlagError."""
    try:
        yield
    except ValueError as error:
        raise FlagError(str(error)) from None
