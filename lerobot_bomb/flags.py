"""Values of flags, and checks of paths and choices; light, as the simulator's processes import it."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path


def flag_value(flags: Sequence[str], name: str) -> str | None:
    """Return a flag's value: 'bomb' of '--env.type=bomb'; None if it is not given."""
    return next((flag.partition("=")[2] for flag in flags if flag.startswith(f"{name}=")), None)


def check_link(flag: str, path: Path) -> None:
    """Raise a ValueError if the new path of a flag is a broken link."""
    if path.is_symlink() and not path.exists():
        raise ValueError(f"{flag}={path} is a link to {path.readlink()}, which does not exist; remove it")


def one_of(flag: str, value: object, allowed: Collection) -> None:
    """Raise a ValueError that names flag, value and choices unless value is allowed."""
    if value not in allowed:
        raise ValueError(f"{flag}={value!r} is unknown; choose one of: {', '.join(map(str, allowed))}")


@contextmanager
def rewording_errors(texts: Mapping[str, str]) -> Iterator[None]:
    """Replace texts in a ValueError's message, because a shared check may name a flag that was not given."""
    try:
        yield
    except ValueError as error:
        message = str(error)
        for usual, other in texts.items():
            message = message.replace(usual, other)
        raise ValueError(message) from None
