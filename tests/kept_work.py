"""Work that LeRobot's commands do anew each time, and that a session of tests does once.

Most of a short command's time went there. Results are the same.
"""

import functools
import inspect
import sys
import threading
import typing
from importlib import metadata
from types import SimpleNamespace
from typing import Any

import pytest


def keep_flags(patch: pytest.MonkeyPatch) -> None:
    """Keep what LeRobot's parser finds out of each field: its help in the source, its type, its action."""
    from draccus.wrappers import dataclass_wrapper, docstring, field_wrapper

    patch.setattr(docstring, "get_attribute_docstring", functools.cache(docstring.get_attribute_docstring))
    hints, arguments = functools.cache(typing.get_type_hints), functools.cache(inspect.getfullargspec)
    patch.setattr(dataclass_wrapper, "typing", SimpleNamespace(get_type_hints=hints))
    patch.setattr(field_wrapper, "inspect", SimpleNamespace(getfullargspec=arguments))


def keep_distributions(patch: pytest.MonkeyPatch) -> None:
    """Keep the metadata of installed packages, among which LeRobot looks for plugins."""
    distributions, text = metadata.distributions, vars(metadata.Distribution)["metadata"]
    found = functools.cache(lambda _: list(distributions()))
    patch.setattr(metadata, "distributions", lambda: found(tuple(sys.path)))
    patch.setattr(metadata.Distribution, "metadata", property(functools.cache(text.fget)))


def look_at_columns_once(patch: pytest.MonkeyPatch) -> None:
    """Let `datasets` look at a column that is set, not at every other one too: LeRobot's have hundreds."""
    from datasets.features.features import Features, require_decoding

    def set_feature(features: Any, column: str, feature: Any) -> None:
        dict.__setitem__(features, column, feature)
        features._column_requires_decoding[column] = require_decoding(feature)

    patch.setattr(Features, "__setitem__", set_feature)


def keep_contexts(patch: pytest.MonkeyPatch) -> list[Any]:
    """Draw in the OpenGL contexts of environments that were closed, as each compiles its shaders anew.

    Return those that no environment has.
    """
    render: Any = sys.modules["lerobot_env_bomb.bomb.render"]
    usual, idle, here = render.GLContext, [], threading.main_thread()

    class KeptContext:
        def __init__(self, *size: int) -> None:
            self._is_kept = threading.current_thread() is here
            self._context = idle.pop() if self._is_kept and idle else usual(*size)

        def make_current(self) -> None:
            self._context.make_current()

        def free(self) -> None:
            if self._is_kept:
                idle.append(self._context)
            else:
                self._context.free()

    patch.setattr(render, "GLContext", KeptContext)
    return idle


def check_numbers_once(patch: pytest.MonkeyPatch) -> None:
    """Check once that a tokenizer writes every number digit by digit, not for every policy that has it."""
    from lerobot_bomb.vlm import prompt

    check, checked = prompt._check_numbers, set()

    def check_once(tokenizer: Any, symbols: dict[str, int], *others: Any) -> None:
        seen = (tokenizer.to_str(), *symbols.items(), *others)
        if seen not in checked:
            check(tokenizer, symbols, *others)
            checked.add(seen)

    patch.setattr(prompt, "_check_numbers", check_once)
