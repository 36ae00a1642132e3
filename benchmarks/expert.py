"""Success of the scripted expert on a suite.

    python benchmarks/expert.py --task place --episodes 500 --workers 2 --json expert.json

Prints success with its 95 % Wilson interval, placement error, what happened to the other stones, steps,
idle steps, and every failure with its seed.
"""

import argparse
import json
import multiprocessing
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from tqdm import tqdm

from lerobot_bomb.bomb.board import BOARD
from lerobot_bomb.bomb.episode import CONTROL_MODES, DEFAULT_FPS, ROBOTS, SPLITS, EpisodeSpec
from lerobot_bomb.bomb.observation import MAX_STEP_M, MIN_IMAGE_SIZE, RenderOptions
from lerobot_bomb.bomb.privileged_state import PrivilegedState
from lerobot_bomb.bomb.streams import Stream, generator
from lerobot_bomb.bomb.suites import SUITES
from lerobot_bomb.conditions import NONE
from lerobot_bomb.envs.rollout import Moment, add_noise, expert_agent, play
from lerobot_bomb.stats import format_rate
from lerobot_env_bomb.env import BombEnv

PRECISE_MM = 5.0
IDLE_TRANSLATION_M = 0.0005  # commanded by a step; less counts as none
IDLE_FINGERS_M = 0.0002  # change of the opening over a step; less counts as none


@dataclass(frozen=True)
class Outcome:
    """One episode of the expert."""

    seed: int
    is_success: bool
    is_success_bomb_v0: bool
    progress: float
    failure: str | None
    error_mm: float
    collateral_mm: float
    steps: int
    idle_steps: tuple[int, ...]  # which steps


def run_episode(spec: EpisodeSpec, noise: float) -> Outcome:
    """Let the expert play one episode; `noise` is the standard deviation added to x, y, z, 1 = 40 mm."""
    env = BombEnv(spec, RenderOptions(image_size=MIN_IMAGE_SIZE))
    rng = generator(spec.seed, Stream.EXPERT_NOISE)
    moments = play(env, spec, expert_agent(), lambda a: add_noise(a, noise, spec.control_mode, rng))
    idle = [now.step for now, then in pairwise(moments) if is_idle(now, then, spec)]
    result = env.episode_result()
    env.close()
    return Outcome(
        seed=spec.seed,
        is_success=result.is_success,
        is_success_bomb_v0=result.is_success_bomb_v0,
        progress=result.progress,
        failure=result.failure,
        error_mm=result.placement_error_mm,
        collateral_mm=result.collateral_mm,
        steps=result.steps,
        idle_steps=tuple(idle),
    )


def is_idle(now: Moment, then: Moment, spec: EpisodeSpec) -> bool:
    """Return True if a step, before all is done, neither commands a translation nor moves the fingers."""
    assert now.action is not None
    before, after = now.state, then.state
    xyz = now.action[:3]
    commanded_m = xyz * MAX_STEP_M if spec.control_mode == "relative" else xyz - before.gripper_xyz
    fingers_m = abs(after.finger_opening - before.finger_opening)
    is_still = np.linalg.norm(commanded_m) < IDLE_TRANSLATION_M and fingers_m < IDLE_FINGERS_M
    return bool(is_still and not is_done(before, spec.success_tolerance_mm))


def is_done(state: PrivilegedState, tolerance_mm: float) -> bool:
    """Return True if the last stone lies on its target and the fingers, open, have left it."""
    goal = state.goals[-1]
    stone_xyz = state.stone_xyz[goal.stone]
    error_mm = 1e3 * np.linalg.norm((stone_xyz - goal.xyz)[:2])
    is_clear = state.gripper_xyz[2] > stone_xyz[2] + BOARD.stone_height_m
    is_open = state.finger_opening > 2 * state.stone_radius_m
    return bool(error_mm <= tolerance_mm and is_clear and is_open)


def summarize(outcomes: list[Outcome]) -> dict[str, object]:
    """Figures of all episodes, ready for JSON."""
    n = len(outcomes)
    error_mm = np.array([o.error_mm for o in outcomes])
    failures = defaultdict(list)
    for o in outcomes:
        if o.failure is not None:
            failures[str(o.failure)].append(o.seed)
    return {
        "success": format_rate(sum(o.is_success for o in outcomes), n),
        "success_bomb_v0": format_rate(sum(o.is_success_bomb_v0 for o in outcomes), n),
        "success_within_5_mm": format_rate(
            sum(o.is_success and o.error_mm <= PRECISE_MM for o in outcomes), n
        ),
        "moves_made": f"{100 * np.mean([o.progress for o in outcomes]):.1f} %",
        "error_mm_median_p95_max": [round(float(np.percentile(error_mm, q)), 3) for q in (50, 95, 100)],
        "collateral_mm_max": round(max(o.collateral_mm for o in outcomes), 3),
        "steps_median_max": [float(np.median([o.steps for o in outcomes])), max(o.steps for o in outcomes)],
        "idle_steps": sum(len(o.idle_steps) for o in outcomes),
        "seeds_with_idle_steps": [o.seed for o in outcomes if o.idle_steps],
        "failures": dict(failures),
    }


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", choices=SUITES, default="place", help="suite (default: place)")
    parser.add_argument("--episodes", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0, help="of the first episode; the others count up")
    parser.add_argument("--robot", choices=ROBOTS, default="scara")
    parser.add_argument("--control_mode", choices=CONTROL_MODES, default="relative")
    parser.add_argument("--fps", type=int, default=DEFAULT_FPS)
    parser.add_argument("--split", choices=SPLITS, default="all")
    parser.add_argument(
        "--noise", type=float, default=0.0, help="standard deviation added to x, y, z; 1 = 40 mm"
    )
    parser.add_argument("--perturbations", default=NONE, help="a condition, as camera:3 or all:5")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--json", type=Path, help="write figures and episodes here")
    args = parser.parse_args()

    spec = EpisodeSpec(
        seed=args.seed,
        suite=args.task,
        robot=args.robot,
        control_mode=args.control_mode,
        fps=args.fps,
        split=args.split,
        perturbations=args.perturbations,
    )
    specs = [replace(spec, seed=args.seed + i) for i in range(args.episodes)]
    with multiprocessing.get_context("forkserver").Pool(args.workers) as pool:
        results: Iterable[Outcome] = pool.imap(partial(run_episode, noise=args.noise), specs, chunksize=4)
        outcomes = list(tqdm(results, total=args.episodes, unit="episode"))
    figures = summarize(outcomes)
    for name, value in figures.items():
        print(f"{name:24} {value}")
    if args.json:
        episodes = [vars(o) for o in outcomes]
        args.json.write_text(json.dumps({"figures": figures, "episodes": episodes}, indent=1) + "\n")


if __name__ == "__main__":
    main()
