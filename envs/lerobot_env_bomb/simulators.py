"""The simulators that BOMB can be run in, and the check that the chosen one is installed.

Imports no simulator, so that flags are checked at once.
"""

import importlib.util


def check_simulator(simulator: str) -> None:
    """Raise a ValueError unless a simulator is installed."""
    if simulator == "sapien" and importlib.util.find_spec("sapien") is None:
        raise ValueError(
            "--env.simulator=sapien needs SAPIEN, which is not installed: "
            "pip install 'lerobot_policy_bomb[sapien]', or choose --env.simulator=mujoco"
        )
