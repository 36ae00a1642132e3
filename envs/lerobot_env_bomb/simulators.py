"""The simulators that BOMB can be run in, and the check that the chosen one is installed.

Imports no simulator, so that flags are checked at once.
"""

import importlib.util

from lerobot_bomb.bomb.episode import EpisodeSpec

MISSING_SAPIEN = (
    "--env.simulator=sapien needs SAPIEN, which is not installed: pip install 'lerobot_policy_bomb[sapien]', "
    "or choose --env.simulator=mujoco"
)


def check_simulator(spec: EpisodeSpec) -> None:
    """Raise a ValueError unless the spec's simulator is installed."""
    if spec.simulator == "sapien" and importlib.util.find_spec("sapien") is None:
        raise ValueError(MISSING_SAPIEN)
