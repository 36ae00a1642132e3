"""Registries: what this package has by name, and what other packages add through entry points."""

from collections.abc import Iterator, Mapping
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from pkgutil import resolve_name
from typing import Any


class Registry[T](Mapping[str, T]):
    """Objects by name: this package's, then those of other packages; each is imported when it is asked for.

    Args:
        group: of the entry points: "lerobot_bomb.suites".
        own: the objects, or where they are: "module:name".
        prefix: of the entry points' names, if several registries share a group.
    """

    def __init__(self, group: str, own: Mapping[str, T | str], prefix: str = "") -> None:
        self.own = own
        self._group, self._prefix = group, prefix
        self._found: dict[str, T] = {}

    @cached_property
    def _added(self) -> dict[str, EntryPoint]:
        """Entry points of other packages, by name.

        Raises:
            RuntimeError: two packages add the same name, or one adds a name of this package's.
        """
        added: dict[str, EntryPoint] = {}
        for each in entry_points(group=self._group):
            name = each.name.removeprefix(self._prefix)
            if not each.name.startswith(self._prefix):
                continue
            if name in self.own or name in added:
                raise RuntimeError(f"{_text(each)}: there is another {name}; uninstall one of the two")
            added[name] = each
        return dict(sorted(added.items()))

    def __getitem__(self, name: str) -> T:
        if name not in self._found:
            if name in self.own:
                own: Any = self.own[name]
                self._found[name] = resolve_name(own) if isinstance(own, str) else own
            else:
                self._found[name] = _load(self._added[name])
        return self._found[name]

    def __contains__(self, name: object) -> bool:
        return name in self.own or name in self._added

    def __iter__(self) -> Iterator[str]:
        yield from self.own
        yield from self._added

    def __len__(self) -> int:
        return len(self.own) + len(self._added)


def _load(added: EntryPoint) -> Any:
    try:
        return added.load()
    except (ImportError, AttributeError) as error:
        raise RuntimeError(f"{_text(added)} cannot be imported: {error}") from error


def _text(added: EntryPoint) -> str:
    package = "another package" if added.dist is None else added.dist.name
    return f"the entry point {added.group}: {added.name} = {added.value} of {package}"
