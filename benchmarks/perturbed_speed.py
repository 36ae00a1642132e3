"""Cost of a perturbation: a reset, and a step with two 256x256 cameras, beside the unperturbed episode.

    OMP_NUM_THREADS=1 python benchmarks/perturbed_speed.py --json perturbed_speed.json
    OMP_NUM_THREADS=1 python benchmarks/perturbed_speed.py --env.type=bomb_pusht --episodes=300
    OMP_NUM_THREADS=1 python benchmarks/perturbed_speed.py --env.type=bomb_libero --episodes=5

Both environments take turns, reset by reset and step by step, with the same seeds and actions. `bomb_pusht`'s
resets stand beside those of gym-pusht itself, `bomb_libero`'s resets and steps beside those of LeRobot's
`libero`, in CPU time.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from statistics import median
from typing import Any

import gymnasium
import numpy as np
from machine import (
    Rows,
    add_machine_arguments,
    make_parser,
    milliseconds,
    positive,
    print_rows,
    require_idle_machine,
    write_figures,
)

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.bomb.perturbations import AXES
from lerobot_bomb.conditions import MAX_LEVEL, NONE
from lerobot_bomb.libero.assets import prepare_libero
from lerobot_bomb.libero.episode import LiberoSpec
from lerobot_bomb.libero.perturbations import LIBERO_AXES
from lerobot_bomb.pusht.episode import IMAGE_SIZE, PushTSpec
from lerobot_bomb.pusht.perturbations import PUSHT_AXES
from lerobot_bomb.viewing.pusht import make_pusht_env
from lerobot_env_bomb.env import BombEnv

NUM_STEPS = 8  # of each episode
TARGETS = {
    "bomb": "targets: a reset 1.5, a step 1.1",
    "bomb_pusht": "target: a reset 1.3",
    "bomb_libero": "target: a reset 1.3",
}
ALL = f"all:{MAX_LEVEL}"
LIBERO_SUITE, LIBERO_IMAGE_SIZE, STOCK = "libero_spatial", 256, "LeRobot's libero"

cpu_milliseconds = partial(milliseconds, clock=time.process_time)


def conditions(axes: Any) -> list[str]:
    """Return each axis at its highest level, then all axes together."""
    return [*(f"{axis}:{MAX_LEVEL}" for axis in axes), ALL]


def main() -> None:
    """Measure each axis at its highest level, print medians and ratios."""
    measures = {"bomb": measure_bomb, "bomb_pusht": measure_pusht, "bomb_libero": measure_libero}
    parser = make_parser(__doc__)
    parser.add_argument("--env.type", dest="env_type", choices=[*measures], default="bomb")
    parser.add_argument("--episodes", type=positive, default=60, help="of each condition (default: 60)")
    add_machine_arguments(parser)
    args = parser.parse_args()
    require_idle_machine(args.force)
    figures = measures[args.env_type](args.episodes)
    print_rows(f"{args.env_type}, {args.episodes} episodes; {TARGETS[args.env_type]}", figures)
    write_figures(args.json, {"episodes": args.episodes, "conditions": figures})


def row(resets: list[float], stock_resets: list[float], steps: list[float], stock_steps: list[float]) -> dict:
    """Return a condition's median milliseconds, each with its ratio to the stock median."""
    times = {"reset": (median(resets), median(stock_resets)), "step": (median(steps), median(stock_steps))}
    return {
        f"{name}_{figure}": value
        for name, (ms, stock_ms) in times.items()
        for figure, value in {"ms": ms, "ratio": ms / stock_ms}.items()
    }


def seeded_actions(seed: int, num_dims: int) -> np.ndarray:
    """Draw random actions (NUM_STEPS, num_dims)."""
    return np.random.default_rng(seed).uniform(-0.3, 0.3, (NUM_STEPS, num_dims)).astype(np.float32)


def measure_bomb(num_episodes: int) -> Rows:
    """Time each condition in turn with the unperturbed environment."""
    figures = {}
    for condition in conditions(AXES):
        envs = [BombEnv(EpisodeSpec(0, perturbations=name), RenderOptions()) for name in (condition, NONE)]
        for env in envs:
            env.reset(seed=0)  # compiles the model, opens OpenGL
        resets: list[list[float]] = [[], []]
        steps: list[list[float]] = [[], []]
        for seed in range(num_episodes):
            for env, times in zip(envs, resets, strict=True):
                times.append(milliseconds(partial(env.reset, seed=seed)))
            for action in seeded_actions(seed, 4):
                for env, times in zip(envs, steps, strict=True):
                    times.append(milliseconds(partial(env.step, action)))
        for env in envs:
            env.close()
        figures[condition] = row(*resets, *steps)
    return figures


def measure_pusht(num_episodes: int) -> Rows:
    """Time the resets of each condition beside gym-pusht's own."""
    stock = gymnasium.make("gym_pusht:gym_pusht/PushT-v0", obs_type="pixels_agent_pos").unwrapped
    names = [NONE, *conditions(PUSHT_AXES)]
    envs = [make_pusht_env(PushTSpec(0, perturbations=name), IMAGE_SIZE).unwrapped for name in names]
    for env in (stock, *envs):
        env.reset(seed=0)
    resets = [
        [cpu_milliseconds(partial(env.reset, seed=seed)) for env in (stock, *envs)]
        for seed in range(num_episodes)
    ]
    stock_ms, *ours_ms = map(median, zip(*resets, strict=True))
    figures = {"gym-pusht": {"reset_ms": stock_ms, "reset_ratio": 1.0}}
    for name, ms in zip(names, ours_ms, strict=True):
        figures[name] = {"reset_ms": ms, "reset_ratio": ms / stock_ms}
    return figures


def measure_libero(num_episodes: int) -> Rows:
    """Time each condition beside LeRobot's `libero`."""
    prepare_libero([LIBERO_SUITE])
    from lerobot.envs.factory import make_env as make_stock
    from lerobot.envs.factory import make_env_config

    from lerobot_env_bomb_libero.env import BombLiberoEnv

    size = {"observation_height": LIBERO_IMAGE_SIZE, "observation_width": LIBERO_IMAGE_SIZE}
    config = make_env_config("libero", task=LIBERO_SUITE, task_ids=[0], **size)
    vector: Any = make_stock(config, n_envs=1)[LIBERO_SUITE][0]
    stock = vector.envs[0].unwrapped
    # robosuite draws and frees in whichever OpenGL context is current
    use_stock: Callable[[], None] = stock._env.sim._render_context_offscreen.gl_ctx.make_current
    scene = size | {"obs_type": "pixels_agent_pos"}
    ours = {
        condition: BombLiberoEnv(LiberoSpec(0, LIBERO_SUITE, perturbations=condition), scene)
        for condition in (NONE, ALL)
    }
    for env in (stock, *ours.values()):
        env.reset(seed=0)
    names = [STOCK, NONE, *conditions(LIBERO_AXES)]
    resets: Any = {name: [] for name in names}
    steps: Any = {name: [] for name in names}
    for seed in range(num_episodes):
        for name in names:
            env: Any = stock
            if name == STOCK:
                use_stock()
            else:
                env = ours[NONE if name == NONE else ALL]
                env._spec = replace(env._spec, perturbations=name)
            resets[name].append(cpu_milliseconds(partial(env.reset, seed=seed)))
            steps[name] += [cpu_milliseconds(partial(env.step, action)) for action in seeded_actions(seed, 7)]
    for env in ours.values():
        env.close()
    use_stock()
    stock.close()
    return {name: row(resets[name], resets[STOCK], steps[name], steps[STOCK]) for name in names}


if __name__ == "__main__":
    main()
