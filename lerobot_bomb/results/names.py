"""Short names of policies, each the shortest that tells it from those beside it."""

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

from lerobot_bomb.results.origin import NOT_RECORDED, PolicyIdentity
from lerobot_bomb.tables import num_shared

UNKNOWN = "policy not recorded"
SHIPPED_PREFIX = "bomb:"  # of the names of checkpoints that come with the package
SHIPPED_FOLDER = re.compile(r"(?:^|/)lerobot_bomb/checkpoints/weights/([^/]+)/?$")
SHOWN_DIGITS = 6  # of a SHA-256, where names are the same otherwise

# makes a part of a name for each of several policies, which tells them apart
type Parts = Callable[[Sequence[PolicyIdentity]], list[str]]


def policy_key(policy: PolicyIdentity | None) -> str:
    """Return a key that is equal for the same weights with the same settings."""
    return NOT_RECORDED if policy is None else policy.key


def policy_names(
    policies: Sequence[PolicyIdentity | None], given: Mapping[str, str] | None = None
) -> list[str]:
    """Name each policy: its type or `bomb:NAME`; of one type, also the parts of their paths that differ.

    `given`: {key of a policy: its name}.
    """
    known = [each or PolicyIdentity(UNKNOWN) for each in policies]
    names = [shipped_name(each.path or "") or each.type for each in known]
    for parts in (_path_parts, _interventions, _steps, _weights, _settings):
        names = _extended(names, known, parts)
    chosen = given or {}
    return numbered([chosen.get(policy_key(each), name) for each, name in zip(policies, names, strict=True)])


def numbered(names: Sequence[str]) -> list[str]:
    """Make equal names different: 'act (1)', 'act (2)'."""
    doubled = {name for name, number in Counter(names).items() if number > 1}
    numbers = Counter[str]()
    told = []
    for name in names:
        numbers[name] += 1
        told.append(f"{name} ({numbers[name]})" if name in doubled else name)
    return told


def shipped_name(path: str) -> str | None:
    """Return `bomb:NAME` for the folder of a shipped checkpoint, on any machine; None for any other path."""
    found = SHIPPED_FOLDER.search(path)
    return f"{SHIPPED_PREFIX}{found[1]}" if found else None


def _extended(names: list[str], policies: Sequence[PolicyIdentity], parts: Parts) -> list[str]:
    """Add a part to every name that several policies have."""
    extended = list(names)
    for name, number in Counter(names).items():
        if number > 1:
            places = [place for place, each in enumerate(names) if each == name]
            for place, part in zip(places, parts([policies[each] for each in places]), strict=True):
                extended[place] = f"{name} {part}".strip()
    return extended


def _path_parts(policies: Sequence[PolicyIdentity]) -> list[str]:
    """Return the parts of the policies' paths between those that all begin and end with."""
    paths = [(each.path or "").strip("/").split("/") for each in policies]
    first = num_shared(paths)
    paths = [path[first:] for path in paths]
    last = num_shared([path[::-1] for path in paths])
    return ["/".join(path[: len(path) - last]) for path in paths]


def _interventions(policies: Sequence[PolicyIdentity]) -> list[str]:
    return [" ".join(f"with {name}" for name in each.interventions) for each in policies]


def _steps(policies: Sequence[PolicyIdentity]) -> list[str]:
    steps = [each.training_step for each in policies]
    return ["" if step is None else f"step {step}" for step in steps]


def _weights(policies: Sequence[PolicyIdentity]) -> list[str]:
    return [(each.weights_sha256 or "")[:SHOWN_DIGITS] for each in policies]


def _settings(policies: Sequence[PolicyIdentity]) -> list[str]:
    return [(each.settings_sha256 or "")[:SHOWN_DIGITS] for each in policies]
