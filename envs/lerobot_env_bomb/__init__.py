"""BOMB's simulator, and PushT and LIBERO with BOMB's axes, as Gymnasium environments.

Imports neither torch nor lerobot, so that an environment's worker process starts fast.
"""

import lerobot_env_bomb.bomb
import lerobot_env_bomb.libero
import lerobot_env_bomb.pusht  # noqa: F401  each registers its ids
