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
from dataclasses import dataclass, field, replace
from functools import partial
from statistics import median
from typing import Any

import gymnasium
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


def main() -> None:
    """Measure each axis at its highest level, print medians and ratios."""
    measures = {"bomb": measure_bomb, "bomb_pusht": measure_pusht, "bomb_libero": measure_libero}
    parser = make_parser(__doc__)
    parser.add_argument("--env.type", dest="env_type", choices=[*measures], default="bomb")
    parser.add_argument("--episodes", type=positive, default=60, help="of each condition (default: 60)")
    args = parse_on_idle_machine(parser)
    figures = measures[args.env_type](args.episodes)
    print_rows(f"{args.env_type}, {args.episodes} episodes; {TARGETS[args.env_type]}", figures)
    write_figures(args.json, {"episodes": args.episodes, "conditions": figures})


def conditions(axes: Any) -> list[str]:
    """Return each axis at its highest level, then all axes together."""
    return [*(f"{axis}:{MAX_LEVEL}" for axis in axes), ALL]


@dataclass
class Times:
    """Milliseconds of the resets and the steps of one environment."""

    resets: list[float] = field(default_factory=list)
    steps: list[float] = field(default_factory=list)

    def row(self, stock: "Times") -> dict[str, float]:
        """Return the medians, each with its ratio to the stock median."""
        figures = {}
        for name in ("reset", "step"):
            if times := getattr(self, f"{name}s"):
                figures[f"{name}_ms"] = median(times)
                figures[f"{name}_ratio"] = median(times) / median(getattr(stock, f"{name}s"))
        return figures


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
        both = [(env, Times()) for env in envs]
        for seed in range(num_episodes):
            for env, times in both:
                times.resets.append(milliseconds(partial(env.reset, seed=seed)))
            for action in seeded_actions(seed, 4):
                for env, times in both:
                    times.steps.append(milliseconds(partial(env.step, action)))
        for env in envs:
            env.close()
        (_, perturbed), (_, stock) = both
        figures[condition] = perturbed.row(stock)
    return figures


def measure_pusht(num_episodes: int) -> Rows:
    """Time the resets of each condition beside gym-pusht's own."""
    stock = gymnasium.make("gym_pusht:gym_pusht/PushT-v0", obs_type="pixels_agent_pos").unwrapped
    envs = {"gym-pusht": stock} | {
        name: make_pusht_env(PushTSpec(0, perturbations=name), IMAGE_SIZE).unwrapped
        for name in [NONE, *conditions(PUSHT_AXES)]
    }
    for env in envs.values():
        env.reset(seed=0)
    times = {name: Times() for name in envs}
    for seed in range(num_episodes):
        for name, env in envs.items():
            times[name].resets.append(cpu_milliseconds(partial(env.reset, seed=seed)))
    return {name: each.row(times["gym-pusht"]) for name, each in times.items()}


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
    times = {name: Times() for name in [STOCK, NONE, *conditions(LIBERO_AXES)]}
    for seed in range(num_episodes):
        for name, each in times.items():
            env: Any = stock
            if name == STOCK:
                use_stock()
            else:
                env = ours[NONE if name == NONE else ALL]
                env._spec = replace(env._spec, perturbations=name)
            each.resets.append(cpu_milliseconds(partial(env.reset, seed=seed)))
            each.steps += [cpu_milliseconds(partial(env.step, action)) for action in seeded_actions(seed, 7)]
    for env in ours.values():
        env.close()
    use_stock()
    stock.close()
    return {name: each.row(times[STOCK]) for name, each in times.items()}


if __name__ == "__main__":
    main()
