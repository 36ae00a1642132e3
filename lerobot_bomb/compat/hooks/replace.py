"""The one way in which a hook takes the place of a function or method."""

import inspect
from collections.abc import Callable
from functools import wraps
from typing import Any

ORIGINAL = "_before_lerobot_bomb"


def replace(owner: Any, name: str, around: Callable[[Callable], Callable]) -> None:
    """Put `around(original)` in the place of a function or method; doing it again changes nothing more.

    The original of a class method takes the class first.

    Raises:
        RuntimeError: this version of LeRobot has nothing of that name; nothing may go on without the hook.
    """
    try:
        held = inspect.getattr_static(owner, name)
    except AttributeError:
        raise RuntimeError(
            f"{owner.__name__} has no {name} in the installed version, and lerobot_bomb needs it: "
            "docs/releases.md says which versions go together"
        ) from None
    original = getattr(held, "__func__", held)
    original = getattr(original, ORIGINAL, original)
    new = wraps(original)(around(original))
    setattr(new, ORIGINAL, original)
    setattr(owner, name, classmethod(new) if isinstance(held, classmethod) else new)
