"""Speed of BOMB against FetchPickAndPlace-v4 and robosuite's Lift, and of BOMB in SAPIEN, in one run.

Frames are 256x256, rendered off screen through EGL; a step has two cameras, and each environment runs
at its default control rate. Every environment is measured in processes of its own, in turn.

    OMP_NUM_THREADS=1 python benchmarks/sim_speed.py --json sim_speed.json

robosuite pins packages that conflict with LeRobot's, so it gets an environment of its own:
    python -m venv robosuite-venv && robosuite-venv/bin/pip install robosuite==1.5.2 mujoco==3.8.1
    python benchmarks/sim_speed.py --robosuite_python robosuite-venv/bin/python
"""

import argparse
import json
import multiprocessing
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from machine import Rows, finish, make_parser, milliseconds, parse_on_idle_machine, positive, print_rows

IMAGE_SIZE = 256
NUM_FRAMES = 100
NUM_STEPS = 60  # shorter than an episode
WARM_UP = 5
NUM_WORKER_STEPS = 600

FRAME_BAR, STEP_BAR = 1 / 4, 1 / 12  # at most so much of Fetch's frame, of Lift's step
WORKERS_BAR, START_BAR_S = 1.8, 1.5


def main() -> None:
    """Measure in turn, print medians, ratios and targets."""
    parser = make_parser(__doc__)
    parser.add_argument("--repeats", type=positive, default=3, help="processes of each (default: 3)")
    parser.add_argument("--robosuite_python", default=sys.executable, help="a Python that has robosuite")
    parser.add_argument("--measure", choices=MEASURES, help=argparse.SUPPRESS)
    args = parse_on_idle_machine(parser)
    if args.measure:
        print(json.dumps(MEASURES[args.measure]()))
        return
    os.environ.setdefault("MUJOCO_GL", "egl")
    os.environ.setdefault("PYOPENGL_PLATFORM", os.environ["MUJOCO_GL"])

    rates: dict[str, list[float]] = {"1": [], "2": []}
    for _ in range(args.repeats):  # in turn, for the machine's speed drifts
        for number, runs in rates.items():
            runs.append(worker_rate(int(number)))
    medians = compare_environments(args.repeats, args.robosuite_python)
    figures = {
        "milliseconds": medians,
        "steps_per_s": {number: statistics.median(runs) for number, runs in rates.items()},
        "start_s": {path: start_seconds(path, args.repeats) for path in ("ours", "default", "sapien")},
    }
    report(figures)
    finish(args.json, figures, bars(figures))


def compare_environments(repeats: int, robosuite_python: str) -> Rows:
    """Return {environment: {"frame" or "step": median milliseconds}}; an absent peer is left out."""
    pythons = dict.fromkeys(MEASURES, sys.executable) | {"lift": robosuite_python}
    runs: dict[str, list[dict[str, float]]] = {name: [] for name in pythons}
    for _ in range(repeats):
        for name, python in pythons.items():
            output = run_in_process(
                [python, __file__, "--force", "--measure", name], allow_failure=name in OPTIONAL
            )
            if output is not None:
                runs[name].append(output)
    return {
        name: {key: statistics.median(run[key] for run in outputs) for key in outputs[0]}
        for name, outputs in runs.items()
        if outputs
    }


def run_in_process(command: list[str], allow_failure: bool = False) -> dict[str, float] | None:
    """Run a command, return the JSON on its last line; None if it fails and may."""
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode == 0:
        return json.loads(done.stdout.splitlines()[-1])
    if allow_failure:
        print(f"{command[-1]} does not run: {(done.stderr.splitlines() or ['no message'])[-1]}")
        return None
    raise SystemExit(f"{' '.join(command)} failed:\n{done.stderr}")


def median_ms(action: Callable[[], object], number: int) -> float:
    """Median milliseconds of a call, after a warm-up."""
    for _ in range(WARM_UP):
        action()
    return statistics.median(milliseconds(action) for _ in range(number))


def make_bomb(simulator: str = "mujoco", render_preset: str = "fast"):
    """Make BOMB and reset it."""
    import gymnasium

    from lerobot_bomb.bomb.episode import EpisodeSpec
    from lerobot_bomb.bomb.observation import RenderOptions

    env = gymnasium.make(
        "lerobot_env_bomb:bomb/place-v0",
        disable_env_checker=True,
        spec=EpisodeSpec(seed=0, simulator=simulator),
        render_options=RenderOptions(preset=render_preset),
    )
    env.reset(seed=0)
    return env


def measure_bomb(simulator: str = "mujoco", render_preset: str = "fast") -> dict[str, float]:
    """Milliseconds of one camera's frame, of a step with its two cameras, and of its physics alone."""
    from lerobot_bomb.bomb.episode import DEFAULT_FPS, PHYSICS_HZ

    env = make_bomb(simulator, render_preset)
    draw = env.get_wrapper_attr("_draw")  # render() composes an image for people
    lift = [0.0, 0.0, 0.2, 1.0]
    scene, above = env.get_wrapper_attr("_run").scene, np.array([0.0, 0.0, 0.1])
    return {
        "frame": median_ms(lambda: draw("workspace", IMAGE_SIZE), NUM_FRAMES),
        "step": median_ms(lambda: env.step(lift), NUM_STEPS),
        "physics": median_ms(lambda: scene.move(above, True, PHYSICS_HZ // DEFAULT_FPS), NUM_STEPS),
    }


def measure_fetch() -> dict[str, float]:
    """Milliseconds of one frame."""
    import gymnasium
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    env = gymnasium.make("FetchPickAndPlace-v4", render_mode="rgb_array", width=IMAGE_SIZE, height=IMAGE_SIZE)
    env.reset(seed=0)
    return {"frame": median_ms(env.render, NUM_FRAMES)}


def measure_lift() -> dict[str, float]:
    """Milliseconds of one camera's frame, and of a step with two cameras."""
    import robosuite  # pyright: ignore[reportMissingImports]

    env = robosuite.make(
        "Lift",
        robots="Panda",
        has_renderer=False,
        has_offscreen_renderer=True,
        use_camera_obs=True,
        camera_names=["agentview", "robot0_eye_in_hand"],
        camera_heights=IMAGE_SIZE,
        camera_widths=IMAGE_SIZE,
    )
    env.reset()
    rest = np.zeros(env.action_dim)
    return {
        "frame": median_ms(
            lambda: env.sim.render(IMAGE_SIZE, IMAGE_SIZE, camera_name="agentview"), NUM_FRAMES // 3
        ),
        "step": median_ms(lambda: env.step(rest), NUM_STEPS // 2),
    }


MEASURES = {
    "bomb": measure_bomb,
    "sapien_physics": partial(measure_bomb, "sapien"),
    "sapien_images": partial(measure_bomb, "mujoco", "sapien"),
    "fetch": measure_fetch,
    "lift": measure_lift,
}
OPTIONAL = ("sapien_physics", "sapien_images", "lift")  # need packages or a driver of their own


def worker_rate(num_workers: int) -> float:
    """Return the steps per second, with two cameras, of this many processes at once."""
    context = multiprocessing.get_context("spawn")
    barrier, queue = context.Barrier(num_workers), context.Queue()
    workers = [context.Process(target=run_steps, args=(barrier, queue)) for _ in range(num_workers)]
    for worker in workers:
        worker.start()
    seconds = [queue.get(timeout=120) for _ in workers]
    for worker in workers:
        worker.join()
    return num_workers * NUM_WORKER_STEPS / max(seconds)


def run_steps(barrier, queue) -> None:
    """Put the seconds that the steps took into the queue; workers start together."""
    env = make_bomb()
    env.step([0.0, 0.0, 0.2, 1.0])
    barrier.wait(timeout=120)
    started = time.perf_counter()
    for step in range(NUM_WORKER_STEPS):
        if step % NUM_STEPS == 0:
            env.reset(seed=step)
        env.step([0.0, 0.0, 0.2, 1.0])
    queue.put(time.perf_counter() - started)
    env.close()


def start_seconds(path: str, repeats: int) -> float:
    """Median seconds until two async workers have delivered their first observation."""
    command = [sys.executable, str(Path(__file__).with_name("env_start.py")), path]
    runs = [run_in_process(command) for _ in range(repeats)]
    return statistics.median(run["seconds"] for run in runs if run)


def report(figures: dict) -> None:
    """Print what was measured."""
    milliseconds_of = figures["milliseconds"]
    print_rows(
        "milliseconds; a step has 2 cameras", {name: milliseconds_of.get(name, {}) for name in MEASURES}
    )
    if "lift" not in milliseconds_of:
        print("lift was not measured; see --help for how to install robosuite")
    rate, start = figures["steps_per_s"], figures["start_s"]
    print(f"steps/s with two cameras: {rate['1']:.0f} in one process, {rate['2']:.0f} in two")
    print(
        f"start of two workers: ours {start['ours']:.2f} s, with SAPIEN {start['sapien']:.2f} s, "
        f"LeRobot's default {start['default']:.2f} s"
    )


def bars(figures: dict) -> dict[str, bool]:
    """Return {ratio and its bar, in words: True if the bar is kept}."""
    ms, rate, start_s = figures["milliseconds"], figures["steps_per_s"], figures["start_s"]["ours"]
    frame, workers = ms["bomb"]["frame"] / ms["fetch"]["frame"], rate["2"] / rate["1"]
    kept = {
        f"a frame takes {frame:.3f} of Fetch's (bar {FRAME_BAR:.3f})": frame <= FRAME_BAR,
        f"two workers are {workers:.2f} times as fast as one (bar {WORKERS_BAR})": workers >= WORKERS_BAR,
        f"two workers start in {start_s:.2f} s (bar {START_BAR_S})": start_s < START_BAR_S,
    }
    if "lift" in ms:
        step = ms["bomb"]["step"] / ms["lift"]["step"]
        kept[f"a step takes {step:.3f} of Lift's (bar {STEP_BAR:.3f})"] = step <= STEP_BAR
    return kept


if __name__ == "__main__":
    main()
