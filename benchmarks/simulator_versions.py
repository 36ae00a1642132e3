"""Check of versions of a simulator: under which are episodes the same, bit for bit?

    python benchmarks/simulator_versions.py 3.8.1 3.9.0 4.0.0 --work_dir simulators
    python benchmarks/simulator_versions.py 3.0.3 3.0.2 --simulator=sapien --work_dir simulators

makes a virtual environment per version, without torch and LeRobot, lets the scripted expert run the same
seeds in each, and compares with the first. Without versions, it measures the Python that runs it, and prints
JSON.

States: joint positions and velocities after every control step, float64. Images: both cameras in every
observation, drawn by MuJoCo. They depend on the OpenGL library too, which is named. The processor may matter
as well: simulators and NumPy choose their instructions by it.
"""

import argparse
import hashlib
import importlib.metadata
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

from machine import add_json_argument, make_parser, positive, write_figures

from lerobot_bomb.bomb.episode import EpisodeSpec

ROOT = Path(__file__).resolve().parents[1]
SOURCE_ROOTS = (ROOT, ROOT / "envs")
# what the simulator imports, in the versions that the tests run with
PACKAGES = ("numpy", "gymnasium", "gymnasium-robotics", "opencv-python-headless", "mujoco")
NEEDED = {"mujoco": (), "sapien": ("setuptools<81",)}  # before 3.0.3, SAPIEN imports pkg_resources
ROBOTS = {"mujoco": ("scara", "fetch"), "sapien": ("scara",)}  # simulator -> its robots
CONDITIONS = ("none", "dynamics:5", "all:5")
FIRST_SEED, NUM_SEEDS = 1000, 10
IMAGE_SIZE = 256  # pixels
HASHES, HASH_DIGITS = ("states", "images"), 8  # shown of a hash


type Outcome = dict[str, str | float]
type Measured = dict[str, Any]  # "version", "renderer", "outcomes": {"robot condition": outcome}


def main() -> None:
    """Measure every version and print the table; without versions, measure here and print JSON."""
    parser = make_parser(__doc__)
    parser.add_argument(
        "versions", nargs="*", help="of the simulator; the others are compared with the first"
    )
    parser.add_argument("--simulator", choices=ROBOTS, default="mujoco", help="default: mujoco")
    parser.add_argument("--seeds", type=positive, default=NUM_SEEDS, help="episodes a case (default: 10)")
    parser.add_argument("--work_dir", type=Path, default=Path("simulators"), help="for the environments")
    add_json_argument(parser)
    args = parser.parse_args()
    if not args.versions:
        print(json.dumps(measure_here(args.simulator, args.seeds)))
        return
    from lerobot_bomb.tables import print_table

    measured = [measure(args, version) for version in args.versions]
    print_table(
        [args.simulator, "robot", "condition", "states", "images", "placed", "worst"], cells(measured)
    )
    print(f"drawn by {measured[0]['renderer']}")
    write_figures(args.json, {one["version"]: one for one in measured})


def measure_here(simulator: str, num_seeds: int) -> Measured:
    """Run all cases in this process."""
    from lerobot_env_bomb.bomb.env import BombEnv

    env = BombEnv()
    env.reset(seed=0)
    assert env._renderer is not None
    renderer = str(env._renderer.opengl_renderer)
    env.close()
    outcomes: dict[str, Outcome] = {}
    for robot, condition in product(ROBOTS[simulator], CONDITIONS):
        spec = EpisodeSpec(seed=0, robot=robot, simulator=simulator, perturbations=condition)
        try:
            outcomes[f"{robot} {condition}"] = outcome_of(spec, num_seeds)
        except ValueError as error:  # a robot whose model this version cannot read
            outcomes[f"{robot} {condition}"] = {"error": str(error)}
    return {"version": importlib.metadata.version(simulator), "renderer": renderer, "outcomes": outcomes}


def outcome_of(spec: EpisodeSpec, num_seeds: int) -> Outcome:
    """Run the expert's episodes of a spec; return their hashes (SHA-256) and how they ended."""
    from lerobot_bomb.bomb.observation import PIXELS, RenderOptions
    from lerobot_bomb.envs.rollout import expert_agent, run_episode
    from lerobot_env_bomb.bomb.env import BombEnv

    states, images, results = hashlib.sha256(), hashlib.sha256(), []
    env = BombEnv(spec, RenderOptions(image_size=IMAGE_SIZE))
    for seed in range(FIRST_SEED, FIRST_SEED + num_seeds):
        for moment in run_episode(env, replace(spec, seed=seed), expert_agent()):
            data = env._run.scene.data
            states.update(data.qpos.tobytes() + data.qvel.tobytes())
            for image in moment.observation[PIXELS].values():
                images.update(image.tobytes())
        results.append(env.episode_result())
    env.close()
    return {
        "states": states.hexdigest(),
        "images": images.hexdigest(),
        "successes": sum(result.is_success for result in results),
        "worst_error_mm": max(result.placement_error_mm for result in results),
    }


def measure(args: argparse.Namespace, version: str) -> Measured:
    """Run everything under one version of the simulator, in a virtual environment of its own."""
    folder = (args.work_dir / f"{args.simulator}-{version}").resolve()
    python = folder / "bin" / "python"
    if not python.exists():
        subprocess.run(["uv", "venv", "-q", "-p", sys.executable, str(folder)], check=True)
    versions = {name: importlib.metadata.version(name) for name in PACKAGES} | {args.simulator: version}
    pins = [*(f"{name}=={each}" for name, each in versions.items()), *NEEDED[args.simulator]]
    subprocess.run(["uv", "pip", "install", "-q", "-p", str(python), *pins], check=True)
    env = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, SOURCE_ROOTS))}
    command = [str(python), __file__, f"--simulator={args.simulator}", f"--seeds={args.seeds}"]
    # MuJoCo writes its log where it is started
    run = subprocess.run(command, cwd=folder, env=env, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(run.stdout)


def cells(measured: Sequence[Measured]) -> list[list[str]]:
    """Return a row per version and case; `=` marks a hash equal to the first version's."""
    rows = []
    for one in measured:
        for case, outcome in one["outcomes"].items():
            shown = ["", "", "cannot run", ""]
            if "error" not in outcome:
                first = measured[0]["outcomes"][case]
                equal = {kind: " =" if outcome[kind] == first.get(kind) else "" for kind in HASHES}
                shown = [f"{outcome[kind][:HASH_DIGITS]}{equal[kind]}" for kind in HASHES]
                shown += [str(outcome["successes"]), f"{outcome['worst_error_mm']:.1f} mm"]
            rows.append([one["version"], *case.split(), *shown])
    return rows


if __name__ == "__main__":
    main()
