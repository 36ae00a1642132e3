"""Fields of the package's dataclasses: which are its own, their comments and their defaults."""

import ast
import dataclasses
import inspect
import json
import textwrap
from contextlib import suppress
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
OURS = {"lerobot_bomb", *(path.name for folder in ("envs", "policies") for path in (ROOT / folder).iterdir())}
LEFT_OUT = ("features", "features_map")  # of environments: declared by the code, set by nobody


def is_ours(cls: type) -> bool:
    """Return True for a class of this package, also of its environments and policies."""
    return cls.__module__.partition(".")[0] in OURS


@cache
def comments_of(config_class: type) -> dict[str, str]:
    """{field: the comment above it, or else behind it} of a dataclass and its bases."""
    found: dict[str, str] = {}
    for base in reversed(config_class.__mro__):
        if is_ours(base):
            with suppress(
                OSError
            ):  # a class that was made by a function has no source, and no comments of its own
                found |= _comments_in(textwrap.dedent(inspect.getsource(base)))
    return found


def _comments_in(source: str) -> dict[str, str]:
    lines = source.splitlines()
    (tree,) = ast.parse(source).body
    assert isinstance(tree, ast.ClassDef)
    found = {}
    for node in tree.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            above = node.lineno - 1
            while lines[above - 1].lstrip().startswith("#"):
                above -= 1
            behind = lines[(node.end_lineno or 0) - 1][node.end_col_offset :]
            comment = lines[above : node.lineno - 1] or [behind]
            text = " ".join(line.strip().removeprefix("#").strip() for line in comment)
            found |= {node.target.id: text} if text else {}
    return found


def own_fields(config_class: type) -> list[dataclasses.Field]:
    """Return the fields that this package declares, not those of LeRobot's bases, in the class's order."""
    ours = filter(is_ours, config_class.__mro__)
    names = {name for base in ours for name in vars(base).get("__annotations__", ())}
    fields = dataclasses.fields(config_class)
    return [each for each in fields if each.name in names and each.name not in LEFT_OUT]


def spelled(value: Any) -> str:
    """Spell a default as a flag has it."""
    if isinstance(value, str) and not isinstance(value, Enum):
        return value
    return json.dumps(value, default=lambda other: other.value if isinstance(other, Enum) else str(other))


def default_of(field: dataclasses.Field) -> str:
    """Return the default of a field as Markdown; '' for one that has none."""
    if field.default_factory is not dataclasses.MISSING:
        return f"`{spelled(field.default_factory())}`"
    value = field.default
    is_unset = value is dataclasses.MISSING or value is None or value == ""
    return "" if is_unset else f"`{spelled(value)}`"


def default_in(config_class: type, name: str) -> str:
    """Return the default of a config's field as Markdown; `-` for a field that it does not have."""
    field = next((each for each in own_fields(config_class) if each.name == name), None)
    return "-" if field is None else default_of(field)


def meaning_of(config_class: type, name: str) -> str:
    """Return the explanation of a config's field, with its allowed values."""
    meaning = comments_of(config_class).get(name, "")
    allowed = [*map(str, getattr(config_class, "CHOICES", {}).get(name, ()))]
    return meaning + ("" if all(each in meaning for each in allowed) else f" ({', '.join(allowed)})")
