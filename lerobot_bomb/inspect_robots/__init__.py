"""BOMB's tasks and arm, and LeRobot's checkpoints as policies, for Inspect Robots.

Its command imports the parts that `pyproject.toml` registers whatever it is asked for: they import torch and
LeRobot only when one of them is made.
"""

from collections.abc import Iterator
from contextlib import contextmanager

from inspect_robots.errors import ConfigError


@contextmanager
def config_errors() -> Iterator[None]:
    """Raise ValueErrors of wrong flags as the error that Inspect Robots prints in one line."""
    try:
        yield
    except ValueError as error:
        raise ConfigError(str(error)) from None
