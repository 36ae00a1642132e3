"""What is wrong with a flag: reads paths and choices; light, as the simulator's processes import it."""

import argparse
from collections.abc import Collection
from pathlib import Path


def path_flag(text: str) -> Path:
    """The path that a flag gives, for argparse; ~ is the home folder wherever it stands: --root=~/x.

    Raises:
        argparse.ArgumentTypeError: it is empty, of an unknown user, or not UTF-8.
    """
    if not text:
        raise argparse.ArgumentTypeError("a path must not be empty")
    try:
        text.encode()
        return Path(text).expanduser()
    except UnicodeEncodeError:
        raise argparse.ArgumentTypeError(f"{text!a} is not UTF-8") from None
    except RuntimeError:
        raise argparse.ArgumentTypeError(f"{text}: this user has no home folder here") from None


def check_link(flag: str, path: Path) -> None:
    """Raise a ValueError if what a flag names as new is a link that leads nowhere."""
    if path.is_symlink() and not path.exists():
        raise ValueError(f"{flag}={path} is a link to {path.readlink()}, which does not exist; remove it")


def one_of(flag: str, value: object, allowed: Collection) -> None:
    """Raise a ValueError that names flag, value and choices unless value is allowed."""
    if value not in allowed:
        raise ValueError(f"{flag}={value!r} is unknown; choose one of: {', '.join(map(str, allowed))}")
