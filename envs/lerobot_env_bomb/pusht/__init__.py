"""PushT with BOMB's perturbation axes: gym-pusht's simulation, as a Gymnasium environment.

Imports neither torch nor lerobot, so that an environment's worker process starts fast; only
``configuration_bomb_pusht`` does, and nothing here imports it. gym-pusht is the extra `pusht`.
"""

import gymnasium

GYM_ID = "bomb_pusht/PushT-v0"

# the env truncates by itself, so no max_episode_steps
gymnasium.register(GYM_ID, entry_point="lerobot_env_bomb.pusht.env:BombPushTEnv")
