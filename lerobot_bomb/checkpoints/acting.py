"""The policy that acts in an environment; LeRobot does not tell the environment which."""

import gc
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from lerobot.configs import PreTrainedConfig
from lerobot.policies import PreTrainedPolicy

from lerobot_bomb.compat.hooks.policies import built_policies

OVERRIDE = "override with --env.ignore_checkpoint=true"  # the one way past the check of which policy acts

_acting: ContextVar[PreTrainedConfig | None] = ContextVar("acting", default=None)


@contextmanager
def acting(config: PreTrainedConfig) -> Iterator[None]:
    """Let the policy of this config count as the one that acts, even if none has been built."""
    token = _acting.set(config)
    try:
        yield
    finally:
        _acting.reset(token)


def acting_config() -> PreTrainedConfig | None:
    """Return the config of the policy that acts: the one of `acting`, else of `acting_policy`."""
    policy = None if (config := _acting.get()) else acting_policy()
    return config if policy is None else policy.config


def acting_policy() -> PreTrainedPolicy | None:
    """Return the one policy that this process built and holds; None if it holds none, or several.

    LeRobot's commands build it before they ask an environment for anything but its features.
    """
    if len(built_policies()) > 1:
        gc.collect()  # those that nothing refers to any more; this function must not hold them either
    policies = built_policies()
    if len(policies) > 1:
        names = ", ".join(policy.config.type for policy in policies)
        logging.warning(
            f"which policy acts is neither checked nor named in results: this process holds {len(policies)} "
            f"of them ({names}); drop the others before the environment's first reset"
        )
    return policies[0] if len(policies) == 1 else None


def name_of(config: PreTrainedConfig) -> str:
    """Name a config's policy: 'the checkpoint outputs/act', 'this act'."""
    return f"the checkpoint {config.pretrained_path}" if config.pretrained_path else f"this {config.type}"
