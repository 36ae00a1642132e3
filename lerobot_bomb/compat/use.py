"""The moment at which hooks are installed: the first use of a type or a command of ours.

LeRobot imports the plugin in every command of every user, most of whom use something else.
"""

from collections.abc import Callable, Collection

_packages: set[str] = set()
_waiting: list[Callable[[], None]] = []
_is_in_use = False


def register(packages: Collection[str], hooks: Collection[Callable[[], None]]) -> None:
    """Have the hooks installed with the first use of a type of these packages, or now if there was one."""
    _packages.update(packages)
    _waiting.extend(hooks)
    if _is_in_use:
        use()


def use() -> None:
    """Install the hooks that are not installed yet; every type and command of ours calls this first."""
    global _is_in_use
    _is_in_use = True
    while _waiting:
        _waiting[0]()  # where that fails, the next use fails, too, rather than go on without the hook
        del _waiting[0]


def is_ours(kind: type) -> bool:
    """Return True if a class or a base of it belongs to a registered package."""
    return any(base.__module__.partition(".")[0] in _packages for base in kind.__mro__)


def is_of_ours(module: str) -> bool:
    """Return True if a module belongs to a registered package."""
    return module.partition(".")[0] in _packages
