"""The suites: a file NAME.py here, with its `SUITE`, is the suite NAME."""

from importlib import import_module
from pkgutil import iter_modules
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lerobot_bomb.bomb.suite import Suite

SUITES = tuple(sorted(module.name for module in iter_modules(__path__)))


def find_suite(name: str) -> "Suite":
    """The suite of a name in SUITES."""
    return import_module(f"{__name__}.{name}").SUITE
