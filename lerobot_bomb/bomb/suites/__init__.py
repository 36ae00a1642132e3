"""The suites: a file NAME.py here, with its `SUITE`, is the suite NAME."""

from pkgutil import iter_modules

SUITES = tuple(sorted(module.name for module in iter_modules(__path__)))
