"""Cost of a perturbation: a reset, and a step with two cameras, beside the unperturbed episode.

    OMP_NUM_THREADS=1 python benchmarks/perturbed_speed.py --json perturbed_speed.json
    OMP_NUM_THREADS=1 python benchmarks/perturbed_speed.py --env.type=bomb_libero --episodes=5

All environments take turns, episode by episode, with the same seeds and actions. `bomb_libero` stands beside
LeRobot's `libero`, in CPU time, with its fast images, too.
"""

import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from statistics import median
from typing import Any

import numpy as np
from machine import (
    Rows,
    make_parser,
    milliseconds,
    parse_on_idle_machine,
    positive,
    print_rows,
    write_figures,
)

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.bomb.perturbations import AXES
from lerobot_bomb.conditions import MAX_LEVEL, NONE
from lerobot_bomb.libero.assets import prepare_libero
from lerobot_bomb.libero.episode import LiberoSpec
from lerobot_bomb.libero.perturbations import LIBERO_AXES
from lerobot_env_bomb.bomb.env import BombEnv

NUM_STEPS = 8  # of each episode
TARGETS = {"bomb": "targets: a reset 1.5, a step 1.1", "bomb_libero": "targets: a reset 1.3, fast step 0.25"}
ALL = f"all:{MAX_LEVEL}"
LIBERO_SUITE, LIBERO_IMAGE_SIZE = "libero_spatial", 128
STOCK, FAST = "LeRobot's libero", "render_preset=fast"


def main() -> None:
    """Measure each axis at its highest level, print medians and ratios."""
    measures = {"bomb": measure_bomb, "bomb_libero": measure_libero}
    parser = make_parser(__doc__)
    parser.add_argument("--env.type", dest="env_type", choices=[*measures], default="bomb")
    parser.add_argument("--episodes", type=positive, default=60, help="of each condition (default: 60)")
    args = parse_on_idle_machine(parser)
    figures = measures[args.env_type](args.episodes)
    print_rows(f"{args.env_type}, {args.episodes} episodes; {TARGETS[args.env_type]}", figures)
    write_figures(args.json, {"episodes": args.episodes, "conditions": figures})


def conditions(axes: Iterable[str]) -> list[str]:
    """Return no perturbation, each axis at its highest level, and all axes together."""
    return [NONE, *(f"{axis}:{MAX_LEVEL}" for axis in axes), ALL]


def take_turns(
    names: list[str],
    ready: Callable[[str], Any],
    num_dims: int,
    num_episodes: int,
    clock: Callable[[], float] = time.perf_counter,
) -> Rows:
    """Time the environments that `ready` returns; return medians, each with its ratio to the first name's."""
    times: dict[str, dict[str, list[float]]] = {name: {"reset": [], "step": []} for name in names}
    for seed in range(num_episodes):
        actions = np.random.default_rng(seed).uniform(-0.3, 0.3, (NUM_STEPS, num_dims)).astype(np.float32)
        for name in names:
            env = ready(name)
            times[name]["reset"].append(milliseconds(partial(env.reset, seed=seed), clock))
            times[name]["step"] += [milliseconds(partial(env.step, action), clock) for action in actions]
    first = {key: median(values) for key, values in times[names[0]].items()}
    rows: Rows = {}
    for name in names:
        medians = {key: median(values) for key, values in times[name].items()}
        rows[name] = {f"{key}_ms": value for key, value in medians.items()}
        rows[name] |= {f"{key}_ratio": value / first[key] for key, value in medians.items()}
    return rows


def measure_bomb(num_episodes: int) -> Rows:
    """Time each condition beside the unperturbed environment."""
    envs = {name: BombEnv(EpisodeSpec(0, perturbations=name), RenderOptions()) for name in conditions(AXES)}
    for env in envs.values():
        env.reset(seed=0)  # compiles the model, opens OpenGL
    rows = take_turns(list(envs), envs.__getitem__, 4, num_episodes)
    for env in envs.values():
        env.close()
    return rows


def measure_libero(num_episodes: int) -> Rows:
    """Time each condition beside LeRobot's `libero`."""
    prepare_libero([LIBERO_SUITE])
    from lerobot.envs.factory import make_env as make_stock
    from lerobot.envs.factory import make_env_config

    from lerobot_env_bomb.libero.env import BombLiberoEnv

    size = {"observation_height": LIBERO_IMAGE_SIZE, "observation_width": LIBERO_IMAGE_SIZE}
    config = make_env_config("libero", task=LIBERO_SUITE, task_ids=[0], **size)
    vector: Any = make_stock(config, n_envs=1)[LIBERO_SUITE][0]
    stock = vector.envs[0].unwrapped
    stock.reset(seed=0)  # builds its simulator
    # robosuite draws and frees in whichever OpenGL context is current
    use_stock: Callable[[], None] = stock._env.sim._render_context_offscreen.gl_ctx.make_current
    scene = size | {"obs_type": "pixels_agent_pos"}
    ours = {
        condition: BombLiberoEnv(LiberoSpec(0, LIBERO_SUITE, perturbations=condition), scene)
        for condition in (NONE, ALL)
    }
    ours[FAST] = BombLiberoEnv(LiberoSpec(0, LIBERO_SUITE), scene | {"render_preset": "fast"})
    for env in ours.values():
        env.reset(seed=0)

    def ready(name: str) -> Any:
        if name == STOCK:
            use_stock()
            return stock
        if name == FAST:
            return ours[FAST]
        env = ours[NONE if name == NONE else ALL]
        env._spec = replace(env._spec, perturbations=name)
        return env

    rows = take_turns([STOCK, FAST, *conditions(LIBERO_AXES)], ready, 7, num_episodes, time.process_time)
    for env in ours.values():
        env.close()
    use_stock()
    stock.close()
    return rows


if __name__ == "__main__":
    main()
