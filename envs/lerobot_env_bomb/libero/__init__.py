"""LIBERO with BOMB's perturbation axes, for LeRobot and for Gymnasium.

``configuration_bomb_libero`` registers LeRobot's env type ``bomb_libero``. hf-libero, with robosuite, is the
extra `libero`.
"""

import gymnasium

GYM_ID = "bomb_libero/Libero-v0"

gymnasium.register(GYM_ID, entry_point="lerobot_env_bomb.libero.env:BombLiberoEnv")
