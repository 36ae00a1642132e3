# ruff: noqa: I001
"""LeRobot's LIBERO environment, imported after an OpenGL backend has been chosen."""

from lerobot_env_bomb.shared.mujoco_gl import mujoco
import lerobot_env_bomb.libero.renderer  # noqa: F401
from lerobot.envs.libero import LiberoEnv, get_libero_dummy_action

__all__ = ["LiberoEnv", "get_libero_dummy_action", "mujoco"]
