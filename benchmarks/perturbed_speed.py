"""Cost of a perturbation: a reset, and a step with two 256x256 cameras, beside the unperturbed episode.

    OMP_NUM_THREADS=1 python benchmarks/perturbed_speed.py --json perturbed_speed.json
    OMP_NUM_THREADS=1 python benchmarks/perturbed_speed.py --env.type=bomb_pusht --episodes=300
    OMP_NUM_THREADS=1 python benchmarks/perturbed_speed.py --env.type=bomb_libero --episodes=5

Both environments take turns, reset by reset and step by step, with the same seeds and actions. `bomb_pusht`'s
resets stand beside those of gym-pusht itself, `bomb_libero`'s resets and steps beside those of LeRobot's
`libero`, in CPU time.
"""

import argparse
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import gymnasium
import numpy as np
from machine import add_machine_arguments, positive, require_idle_machine, write_figures

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.bomb.perturbations import AXES
from lerobot_bomb.conditions import MAX_LEVEL, NONE
from lerobot_bomb.envs.rollout import make_pusht_env
from lerobot_bomb.libero.assets import prepare_libero
from lerobot_bomb.libero.episode import LiberoSpec
from lerobot_bomb.libero.perturbations import LIBERO_AXES
from lerobot_bomb.pusht.episode import IMAGE_SIZE, PushTSpec
from lerobot_bomb.pusht.perturbations import PUSHT_AXES
from lerobot_bomb.tables import print_table
from lerobot_env_bomb.env import BombEnv

NUM_STEPS = 8  # of each episode
MAX_RESET_RATIO = 1.5
MAX_STEP_RATIO = 1.1
MAX_PUSHT_RESET_RATIO = 1.3  # of `bomb_pusht` to gym-pusht, under any axis
ENV_TYPES = ("bomb", "bomb_pusht", "bomb_libero")
MAX_LIBERO_RESET_RATIO = 1.3  # of `bomb_libero` to `libero`, under any axis
LIBERO_SUITE, LIBERO_IMAGE_SIZE, STOCK = "libero_spatial", 256, "LeRobot's libero"
LIBERO_CONDITIONS = (NONE, *(f"{axis}:{MAX_LEVEL}" for axis in LIBERO_AXES), f"all:{MAX_LEVEL}")
CONDITIONS = (*(f"{axis}:{MAX_LEVEL}" for axis in AXES), f"all:{MAX_LEVEL}")
PUSHT_CONDITIONS = (NONE, *(f"{axis}:{MAX_LEVEL}" for axis in PUSHT_AXES), f"all:{MAX_LEVEL}")


def main() -> None:
    """Measure each axis at its highest level, print medians and ratios."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--env.type", dest="env_type", choices=("bomb", "bomb_pusht", "bomb_libero"), default="bomb"
    )
    parser.add_argument("--episodes", type=positive, default=60, help="of each condition (default: 60)")
    add_machine_arguments(parser)
    args = parser.parse_args()
    require_idle_machine(args.force)
    if args.env_type == "bomb_pusht":
        measure_resets_of_pusht(args.episodes, args.json)
        return
    if args.env_type == "bomb_libero":
        measure_libero(args.episodes, args.json)
        return
    figures = {condition: measure(condition, range(args.episodes)) for condition in CONDITIONS}
    print_table(
        [
            f"condition, {args.episodes} episodes",
            "reset, ms",
            f"ratio <= {MAX_RESET_RATIO}",
            "step, ms",
            f"ratio <= {MAX_STEP_RATIO}",
        ],
        [[name, *(f"{value:.2f}" for value in values.values())] for name, values in figures.items()],
    )
    write_figures(args.json, {"episodes": args.episodes, "conditions": figures})


def measure(condition: str, seeds: Iterable[int]) -> dict[str, float]:
    """Median milliseconds of a reset and of a step, each with its ratio to the unperturbed one."""
    options = RenderOptions()
    envs = [BombEnv(EpisodeSpec(0), options), BombEnv(EpisodeSpec(0, perturbations=condition), options)]
    for env in envs:
        env.reset(seed=0)  # compiles the model, opens OpenGL
    resets: list[tuple[float, ...]] = []
    steps: list[tuple[float, ...]] = []
    for seed in seeds:
        actions = np.random.default_rng(seed).uniform(-0.3, 0.3, (NUM_STEPS, 4)).astype(np.float32)
        resets.append(tuple(milliseconds(partial(env.reset, seed=seed)) for env in envs))
        steps += [tuple(milliseconds(partial(env.step, action)) for env in envs) for action in actions]
    for env in envs:
        env.close()
    (nominal_reset, reset), (nominal_step, step) = (
        map(median, zip(*of, strict=True)) for of in (resets, steps)
    )
    return {
        "reset_ms": reset,
        "reset_ratio": reset / nominal_reset,
        "step_ms": step,
        "step_ratio": step / nominal_step,
    }


def measure_resets_of_pusht(num_episodes: int, json_path: Path | None) -> None:
    """Print, by condition, the median CPU time of a reset and its ratio to gym-pusht's own."""
    stock = gymnasium.make("gym_pusht:gym_pusht/PushT-v0", obs_type="pixels_agent_pos").unwrapped
    specs = [PushTSpec(0, perturbations=condition) for condition in PUSHT_CONDITIONS]
    envs = [make_pusht_env(spec, IMAGE_SIZE).unwrapped for spec in specs]
    for env in (stock, *envs):
        env.reset(seed=0)
    resets = np.array(
        [
            [milliseconds(partial(env.reset, seed=seed), time.process_time) for env in (stock, *envs)]
            for seed in range(num_episodes)
        ]
    )
    stock_ms, *ours_ms = np.median(resets, axis=0).tolist()
    figures = {
        condition: {"reset_ms": ms, "reset_ratio": ms / stock_ms}
        for condition, ms in zip(PUSHT_CONDITIONS, ours_ms, strict=True)
    }
    print_table(
        [f"condition, {num_episodes} episodes", "reset, CPU ms", f"ratio <= {MAX_PUSHT_RESET_RATIO}"],
        [
            ["gym-pusht", f"{stock_ms:.2f}", "1"],
            *([name, *(f"{value:.2f}" for value in values.values())] for name, values in figures.items()),
        ],
    )
    write_figures(json_path, {"episodes": num_episodes, "stock_ms": stock_ms, "conditions": figures})


def measure_libero(num_episodes: int, json_path: Path | None) -> None:
    """Print, by condition, the median CPU time of a reset and of a step, and ratios to LeRobot's `libero`."""
    prepare_libero([LIBERO_SUITE])
    from lerobot.envs.factory import make_env as make_stock
    from lerobot.envs.factory import make_env_config

    from lerobot_env_bomb_libero.env import BombLiberoEnv

    size = {"observation_height": LIBERO_IMAGE_SIZE, "observation_width": LIBERO_IMAGE_SIZE}
    config = make_env_config("libero", task=LIBERO_SUITE, task_ids=[0], **size)
    vector: Any = make_stock(config, n_envs=1)[LIBERO_SUITE][0]
    stock = vector.envs[0].unwrapped
    scene = size | {"obs_type": "pixels_agent_pos"}
    ours = {
        condition: BombLiberoEnv(LiberoSpec(0, LIBERO_SUITE, perturbations=condition), scene)
        for condition in (NONE, f"all:{MAX_LEVEL}")
    }
    for env in (stock, *ours.values()):
        env.reset(seed=0)
    resets: dict[str, list[float]] = {}
    steps: dict[str, list[float]] = {}
    for seed in range(num_episodes):
        for condition in (STOCK, *LIBERO_CONDITIONS):
            env: Any = stock
            if condition != STOCK:
                env = ours[NONE if condition == NONE else f"all:{MAX_LEVEL}"]
                env._spec = replace(env._spec, perturbations=condition)
            else:  # robosuite draws and frees in whichever OpenGL context is current
                stock._env.sim._render_context_offscreen.gl_ctx.make_current()
            actions = np.random.default_rng(seed).uniform(-0.3, 0.3, (NUM_STEPS, 7)).astype(np.float32)
            reset = partial(env.reset, seed=seed)
            resets.setdefault(condition, []).append(milliseconds(reset, time.process_time))
            steps.setdefault(condition, []).extend(
                milliseconds(partial(env.step, action), time.process_time) for action in actions
            )
    for env in (*ours.values(), stock):
        if env is stock:
            env._env.sim._render_context_offscreen.gl_ctx.make_current()
        env.close()
    stock_reset, stock_step = median(resets[STOCK]), median(steps[STOCK])
    figures = {
        condition: {
            "reset_ms": median(resets[condition]),
            "reset_ratio": median(resets[condition]) / stock_reset,
            "step_ms": median(steps[condition]),
            "step_ratio": median(steps[condition]) / stock_step,
        }
        for condition in resets
    }
    print_table(
        [
            f"condition, {num_episodes} episodes", "reset, CPU ms", f"ratio <= {MAX_LIBERO_RESET_RATIO}",
            "step, CPU ms", "ratio",
        ],
        [[name, *(f"{value:.2f}" for value in values.values())] for name, values in figures.items()],
    )  # fmt: skip
    write_figures(json_path, {"episodes": num_episodes, "conditions": figures})


def milliseconds(call: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    """Return how long a call takes."""
    start = clock()
    call()
    return 1e3 * (clock() - start)


if __name__ == "__main__":
    main()
