"""The check that what simulates and draws an episode is installed.

Imports neither, so that flags are checked at once.
"""

import importlib
import importlib.util
import warnings
from types import ModuleType


def check_simulator(simulator: str = "", render_preset: str = "") -> None:
    """Raise a ValueError unless simulator and renderer are installed."""
    asked = {"--env.simulator": simulator, "--env.render_preset": render_preset}
    flags = [f"{flag}=sapien" for flag, value in asked.items() if value == "sapien"]
    if flags and importlib.util.find_spec("sapien") is None:
        raise ValueError(
            f"{flags[0]} needs SAPIEN, which is not installed: pip install 'lerobot_policy_bomb[sapien]', or "
            "leave it out"
        )


def import_with_sapien(module: str) -> ModuleType:
    """Import a module of this package that needs SAPIEN.

    Raises:
        ValueError: SAPIEN cannot be imported.
    """
    try:
        with warnings.catch_warnings():
            # SAPIEN brings its own
            warnings.filterwarnings("ignore", message="Failed to find system libvulkan")
            return importlib.import_module(f"lerobot_env_bomb.bomb.{module}")
    except ImportError as error:
        raise ValueError(f"SAPIEN cannot be imported ({error}); on Debian it needs libx11-6") from error
