"""What a perturbation costs: a reset, and a step with two 256x256 cameras, beside the unperturbed episode.

    OMP_NUM_THREADS=1 python benchmarks/perturbed_speed.py --json perturbed_speed.json

Both environments take turns, reset by reset and step by step, with the same seeds and actions.
"""

import argparse
import time
from collections.abc import Callable, Iterable
from functools import partial
from statistics import median

import numpy as np
from machine import add_machine_arguments, positive, require_idle_machine, write_figures

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.bomb.perturbations import AXES
from lerobot_bomb.conditions import MAX_LEVEL
from lerobot_bomb.tables import print_table
from lerobot_env_bomb.env import BombEnv

NUM_STEPS = 8  # of each episode
MAX_RESET_RATIO = 1.5
MAX_STEP_RATIO = 1.1
CONDITIONS = (*(f"{axis}:{MAX_LEVEL}" for axis in AXES), f"all:{MAX_LEVEL}")


def main() -> None:
    """Measure each axis at its highest level, print medians and ratios."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=positive, default=60, help="of each condition (default: 60)")
    add_machine_arguments(parser)
    args = parser.parse_args()
    require_idle_machine(args.force)
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


def milliseconds(call: Callable[[], object]) -> float:
    """How long a call takes."""
    start = time.perf_counter()
    call()
    return 1e3 * (time.perf_counter() - start)


if __name__ == "__main__":
    main()
