"""Reading of JSON objects as dataclasses; the type of each field says how it is checked."""

import dataclasses
import json
import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

from lerobot_bomb.tables import printable

SHOWN_CHARACTERS = 80  # of a wrong value

type Check = Callable[[Any], bool]


def between(low: float, high: float = math.inf) -> Check:
    """Return a check for a number in low..high."""
    return lambda value: low <= value <= high


def among(values: Iterable[str]) -> Check:
    """Return a check for one of these texts."""
    return frozenset(map(str, values)).__contains__


def is_positive(value: float) -> bool:
    """Return True for a number above 0."""
    return value > 0


def is_sha256(value: str) -> bool:
    """Return True for a text of 64 hexadecimal digits."""
    return re.fullmatch("[0-9a-f]{64}", value) is not None


# types of fields; a check follows the type of its values
Natural = Annotated[int, between(0)]
Count = Annotated[int, between(1)]
Quantity = Annotated[float, between(0)]
Positive = Annotated[float, is_positive]
Share = Annotated[float, between(0, 1)]
Sha256 = Annotated[str, is_sha256]


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)


SCALARS: dict[Any, Check] = {
    bool: lambda value: value is True or value is False,
    int: lambda value: type(value) is int,  # true and false are none
    float: _is_number,
    str: lambda value: isinstance(value, str),
    Any: lambda value: True,
}


def check_of(hint: Any) -> Check:
    """Return a check for JSON values of a type."""
    origin, args = get_origin(hint), get_args(hint)
    if hint in SCALARS:
        return SCALARS[hint]
    if origin is Annotated:
        inner, meets = check_of(args[0]), args[1]
        return lambda value: inner(value) and meets(value)
    if (some := _without_none(hint)) is not hint:
        inner = check_of(some)
        return lambda value: value is None or inner(value)
    if origin is dict:
        inner = check_of(args[1])
        return lambda value: isinstance(value, dict) and all(map(inner, value.values()))
    if origin is tuple and args[-1] is ...:
        inner = check_of(args[0])
        return lambda value: isinstance(value, list) and all(map(inner, value))
    if origin is tuple:
        each = [*map(check_of, args)]
        return lambda value: (
            isinstance(value, list)
            and len(value) == len(each)
            and all(check(item) for check, item in zip(each, value, strict=True))
        )
    raise TypeError(f"no JSON value is checked against {hint}")


def _without_none(hint: Any) -> Any:
    """X | None -> X; other types as they are."""
    members = [each for each in get_args(hint) if each is not NoneType]
    return members[0] if get_origin(hint) in (Union, UnionType) and len(members) == 1 else hint


def _holds_tuple(hint: Any) -> bool:
    return get_origin(hint) is tuple or any(map(_holds_tuple, get_args(hint)))


def impossible(fields: Mapping[str, Any]) -> ValueError:
    """Return an error that shows a field that is impossible with the others."""
    texts = {name: json.dumps(value) for name, value in fields.items()}
    first, *others = [
        f"{name}={text[:SHOWN_CHARACTERS]}{'...' * (len(text) > SHOWN_CHARACTERS)}"
        for name, text in texts.items()
    ]
    return ValueError(f"{first} is impossible{' with ' * bool(others)}{', '.join(others)}")


class Schema[T]:
    """Fields of a dataclass as a JSON object has them.

    Args:
        cls: the dataclass.
        lacking: {field that an object may lack: its value then}; of a nested one, "spec.task_id".
        closed: names of nested ones that are refused if they have a field that their dataclass lacks.
        name: of the field that the dataclass is nested in; '' for the outermost.
    """

    def __init__(
        self, cls: type[T], lacking: Mapping[str, Any], closed: Collection[str] = (), name: str = ""
    ):
        self._cls, self._name, self._is_closed = cls, name, name in closed
        self._prefix = f"{name}." if name else ""
        hints = get_type_hints(cls, include_extras=True)
        names = [each.name for each in dataclasses.fields(cls)]  # pyright: ignore[reportArgumentType]
        types: dict[str, Any] = {each: hints[each] for each in names}
        self._nested = {
            each: (Schema(some, lacking, closed, self._prefix + each), some is not hint)
            for each, hint in types.items()
            if dataclasses.is_dataclass(some := _without_none(hint)) and isinstance(some, type)
        }
        flat = {each: hint for each, hint in types.items() if each not in self._nested}
        self._checks = {each: check_of(hint) for each, hint in flat.items()}
        self._tuples = [each for each, hint in flat.items() if _holds_tuple(hint)]
        absent = {each: lacking[self._prefix + each] for each in types if self._prefix + each in lacking}
        self._start = {each: absent.get(each) for each in types}
        self._after_init: Callable[[T], None] | None = getattr(cls, "__post_init__", None)
        self._required = [each for each in types if each not in absent]
        self._needs = frozenset(self._required)

    def read(self, values: Mapping[str, Any]) -> T:
        """Read a JSON object as the dataclass.

        Raises:
            ValueError: names missing fields, the first impossible one, or unknown ones of a closed object.
        """
        if not self._needs <= values.keys():
            missing = [f"{self._prefix}{each}" for each in self._required if each not in values]
            raise ValueError(f"it lacks {', '.join(missing)}")
        found: dict[str, Any] = {**self._start}
        for name, is_possible in self._checks.items():
            if name in values:
                found[name] = value = values[name]
                if not is_possible(value):
                    raise self._impossible(name, value)
        for name in self._tuples:
            if found[name] is not None:
                found[name] = tuple(found[name])
        for name, (schema, is_optional) in self._nested.items():
            if name in values:
                value = values[name]
                if not (isinstance(value, dict) or (is_optional and value is None)):
                    raise self._impossible(name, value)
                found[name] = None if value is None else schema.read(value)
        if self._is_closed and (others := values.keys() - found.keys()):
            named = ", ".join(map(printable, sorted(others)))
            raise ValueError(f"{self._name} has {named}, of which this package knows nothing")
        made = object.__new__(self._cls)
        vars(made).update(found)  # what a frozen dataclass's __init__ does field by field, six times as long
        if self._after_init is not None:
            self._after_init(made)
        return made

    def _impossible(self, name: str, value: Any) -> ValueError:
        return impossible({f"{self._prefix}{name}": value})
