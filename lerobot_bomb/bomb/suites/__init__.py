"""The suites: `SUITE` of a file NAME.py here is the suite NAME; other packages may add suites."""

from pkgutil import iter_modules
from typing import Any

from lerobot_bomb.registry import Registry

OWN_SUITES = tuple(sorted(module.name for module in iter_modules(__path__)))  # what `all` stands for
SUITES = Registry[Any]("lerobot_bomb.suites", {name: f"{__name__}.{name}:SUITE" for name in OWN_SUITES})
