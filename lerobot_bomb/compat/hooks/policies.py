"""The policies that a process has built, and their calls; LeRobot tells an environment neither."""

import gc
from collections.abc import Callable
from typing import Any
from weakref import WeakSet, ref

from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import PreTrainedPolicy

from lerobot_bomb.compat.hooks.replace import replace

_BUILT: list[ref[PreTrainedPolicy]] = []  # by `remember_policies`
_WRAPPED: WeakSet[Callable[..., Any]] = WeakSet()  # by `wrap_select_action`


def remember_policies() -> None:
    """Let `built_policies` know every policy that this process builds, LeRobot's own types too.

    `lerobot-eval` and `lerobot-train` build theirs before the first reset of an environment. The garbage
    collector knows those that were built before this call.
    """

    def around(usual: Callable[..., None]) -> Callable[..., None]:
        def remembered(self: PreTrainedPolicy, *args: Any, **kwargs: Any) -> None:
            usual(self, *args, **kwargs)
            _BUILT.append(ref(self))

        return remembered

    known = {id(policy) for policy in built_policies()}
    _BUILT[:0] = [ref(policy) for policy in _living_policies() if id(policy) not in known]
    replace(PreTrainedPolicy, "__init__", around)


def _living_policies() -> list[PreTrainedPolicy]:
    """Return the policies that the garbage collector knows, roughly oldest first."""
    # a collection between two of these calls would move a policy to a generation that was already read
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        return [
            each
            for generation in (2, 1, 0)
            for each in gc.get_objects(generation)
            if issubclass(type(each), PreTrainedPolicy) and "config" in vars(each)
        ]
    finally:
        if was_enabled:
            gc.enable()


def built_policies() -> list[PreTrainedPolicy]:
    """Return the policies that this process built and still holds, oldest first.

    `config.pretrained_path` and `config.pretrained_revision` say where one was loaded from.
    """
    return [policy for built in _BUILT if (policy := built()) is not None]


def training_data(config: PreTrainedConfig) -> LeRobotDatasetMetadata | None:
    """Return the dataset that this process trains a config's policy on; None if it does not train it."""
    return getattr(config, "_runtime_dataset_meta", None)


def wrap_select_action(policy: PreTrainedPolicy, around: Callable[[Callable], Callable]) -> None:
    """Replace the `select_action` of a policy's class by `around(it)`; a second call changes nothing.

    Adapters call the class's method on the policy that they wrap.
    """
    owner: Any = next(each for each in type(policy).__mro__ if "select_action" in vars(each))
    if owner.select_action not in _WRAPPED:
        replace(owner, "select_action", around)
        _WRAPPED.add(owner.select_action)
