"""Checks of flags that are paths or choices; light, as the simulator's processes import it."""

import re
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path


def check_link(flag: str, path: Path) -> None:
    """Raise a ValueError if what a flag names as new is a link that leads nowhere."""
    if path.is_symlink() and not path.exists():
        raise ValueError(f"{flag}={path} is a link to {path.readlink()}, which does not exist; remove it")


def one_of(flag: str, value: object, allowed: Collection) -> None:
    """Raise a ValueError that names flag, value and choices unless value is allowed."""
    if value not in allowed:
        raise ValueError(f"{flag}={value!r} is unknown; choose one of: {', '.join(map(str, allowed))}")


@contextmanager
def flags_without_group(renamed: Mapping[str, str] | None = None) -> Iterator[None]:
    """Name flags in a ValueError as lerobot-bomb does; LeRobot's commands call them --env.*, as --env.type.

    ``renamed``: other texts, which are replaced first.
    """
    try:
        yield
    except ValueError as error:
        message = str(error)
        for usual, name in (renamed or {}).items():
            message = message.replace(usual, name)
        raise ValueError(re.sub(r"--env\.(?!type\b)", "--", message)) from None
