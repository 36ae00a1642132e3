"""What a perturbation costs: a reset, and a step with two 256x256 cameras, beside the unperturbed episode.

    OMP_NUM_THREADS=1 python benchmarks/perturbed_speed.py --json perturbed_speed.json
    OMP_NUM_THREADS=1 python benchmarks/perturbed_speed.py --env.type=bomb_pusht --episodes=300

Both environments take turns, reset by reset and step by step, with the same seeds and actions. `bomb_pusht`'s
resets stand beside those of gym-pusht itself, in CPU time.
"""

import argparse
import time
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from statistics import median

import gymnasium
import numpy as np
from machine import add_machine_arguments, positive, require_idle_machine, write_figures

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.bomb.perturbations import AXES
from lerobot_bomb.conditions import MAX_LEVEL, NONE
from lerobot_bomb.envs.rollout import make_pusht_env
from lerobot_bomb.pusht.episode import IMAGE_SIZE, PushTSpec
from lerobot_bomb.pusht.perturbations import PUSHT_AXES
from lerobot_bomb.tables import print_table
from lerobot_env_bomb.env import BombEnv

NUM_STEPS = 8  # of each episode
MAX_RESET_RATIO = 1.5
MAX_STEP_RATIO = 1.1
MAX_PUSHT_RESET_RATIO = 1.3  # of `bomb_pusht` to gym-pusht, under any axis
CONDITIONS = (*(f"{axis}:{MAX_LEVEL}" for axis in AXES), f"all:{MAX_LEVEL}")
PUSHT_CONDITIONS = (NONE, *(f"{axis}:{MAX_LEVEL}" for axis in PUSHT_AXES), f"all:{MAX_LEVEL}")


def main() -> None:
    """Measure each axis at its highest level, print medians and ratios."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--env.type", dest="env_type", choices=("bomb", "bomb_pusht"), default="bomb")
    parser.add_argument("--episodes", type=positive, default=60, help="of each condition (default: 60)")
    add_machine_arguments(parser)
    args = parser.parse_args()
    require_idle_machine(args.force)
    if args.env_type == "bomb_pusht":
        measure_resets_of_pusht(args.episodes, args.json)
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


def milliseconds(call: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    """How long a call takes."""
    start = clock()
    call()
    return 1e3 * (clock() - start)


if __name__ == "__main__":
    main()
