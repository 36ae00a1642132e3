"""BOMB's simulator: a robot arm that places Go stones, as Gymnasium environments.

Imports neither torch nor lerobot, so that an environment's worker process starts fast; only
``configuration_bomb`` does, and nothing here imports it.
"""

import gymnasium

from lerobot_bomb.bomb.episode import CONTROL_MODES, EpisodeSpec
from lerobot_bomb.bomb.suites import SUITES

# Gymnasium id -> spec of its episodes: bomb/place-v0 (relative control), bomb/place-absolute-v0, ...
GYM_IDS = {
    f"bomb/{suite}{'' if mode == 'relative' else '-' + mode}-v0": EpisodeSpec(
        0, suite, "so101" if mode == "joints" else "scara", control_mode=mode
    )
    for suite in SUITES
    for mode in CONTROL_MODES
}

for _gym_id, _spec in GYM_IDS.items():
    # the env truncates by itself, so no max_episode_steps
    gymnasium.register(_gym_id, entry_point="lerobot_env_bomb.bomb.env:BombEnv", kwargs={"spec": _spec})
