"""Seconds from `create_envs` to the first observation of two async workers; run by sim_speed.py.

LeRobot is imported at the top, as the script of ``lerobot-eval`` does: multiprocessing repeats the
imports of the main script in every child unless somebody prevents it.

    python benchmarks/env_start.py ours|default|sapien
"""

import json
import sys
import time
from typing import Any

from lerobot.envs import EnvConfig

from lerobot_env_bomb.bomb.configuration_bomb import BombEnvConfig

NUM_ENVS = 2


def main() -> None:
    """Print {"seconds": ...} as the last line."""
    path = sys.argv[1]
    config = BombEnvConfig(simulator="sapien" if path == "sapien" else "mujoco")
    create_envs = {"default": EnvConfig.create_envs}.get(path, BombEnvConfig.create_envs)
    started = time.perf_counter()
    suites: Any = create_envs(config, NUM_ENVS, use_async_envs=True)
    env = next(iter(next(iter(suites.values())).values()))
    env.reset(seed=list(range(NUM_ENVS)))
    seconds = time.perf_counter() - started
    env.close()
    print(json.dumps({"seconds": seconds}))


if __name__ == "__main__":
    main()
