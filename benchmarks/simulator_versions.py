"""Check of MuJoCo versions: under which are episodes the same, bit for bit?

    python benchmarks/simulator_versions.py 3.8.1 3.9.0 4.0.0 --work_dir simulators

makes a virtual environment per version, without torch and LeRobot, lets the scripted expert run the same
seeds in each, and compares with the first. `--here` measures the Python that runs it, and prints JSON.

States: joint positions and velocities after every control step, float64. Images: both cameras in every
observation. They depend on the OpenGL library too, which the table names. The processor may matter as well:
MuJoCo and NumPy choose their instructions by it.
"""

import hashlib
import importlib.metadata
import json
import os
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path

from machine import make_parser, writable, write_figures

ROOT = Path(__file__).resolve().parents[1]
SOURCE_ROOTS = (ROOT, ROOT / "envs")
# what the simulator imports, in the versions that the tests run with
PACKAGES = ("numpy", "gymnasium", "gymnasium-robotics", "opencv-python-headless")
ROBOTS = ("scara", "fetch")
CONDITIONS = ("none", "dynamics:5", "all:5")
FIRST_SEED, NUM_SEEDS = 1000, 10
IMAGE_SIZE = 256  # pixels
HASH_DIGITS = 8  # shown of a hash


@dataclass(frozen=True)
class Outcome:
    """Outcome of the expert's episodes of one robot under one condition."""

    states: str  # SHA-256
    images: str  # SHA-256
    successes: int
    episodes: int
    worst_error_mm: float


@dataclass(frozen=True)
class Measured:
    """Outcomes of all episodes under one MuJoCo version."""

    mujoco: str
    renderer: str
    outcomes: dict[str, Outcome | str]  # by "robot condition"; text: why there are none


def measure_here(conditions: Iterable[str], seeds: range) -> Measured:
    """Run all robots under all conditions in this process."""
    outcomes: dict[str, Outcome | str] = {}
    for robot, condition in product(ROBOTS, conditions):
        try:
            outcomes[f"{robot} {condition}"] = outcome_of(robot, condition, seeds)
        except ValueError as error:  # a robot whose model this version cannot read
            outcomes[f"{robot} {condition}"] = str(error)
    return Measured(importlib.metadata.version("mujoco"), renderer_name(), outcomes)


def outcome_of(robot: str, condition: str, seeds: range) -> Outcome:
    """Run the expert on these seeds."""
    from lerobot_bomb.bomb.episode import EpisodeSpec
    from lerobot_bomb.bomb.observation import PIXELS, RenderOptions
    from lerobot_bomb.envs.rollout import expert_agent, run_episode
    from lerobot_env_bomb.env import BombEnv

    states, images, results = hashlib.sha256(), hashlib.sha256(), []
    spec = EpisodeSpec(seed=0, robot=robot, perturbations=condition)
    env = BombEnv(spec, RenderOptions(image_size=IMAGE_SIZE))
    for seed in seeds:
        for moment in run_episode(env, replace(spec, seed=seed), expert_agent()):
            data = env._run.scene.data
            states.update(data.qpos.tobytes() + data.qvel.tobytes())
            for image in moment.observation[PIXELS].values():
                images.update(image.tobytes())
        results.append(env.episode_result())
    env.close()
    return Outcome(
        states=states.hexdigest(),
        images=images.hexdigest(),
        successes=sum(result.is_success for result in results),
        episodes=len(results),
        worst_error_mm=max(result.placement_error_mm for result in results),
    )


def renderer_name() -> str:
    """Return the name of OpenGL's renderer."""
    from lerobot_env_bomb.env import BombEnv

    env = BombEnv()
    env.reset(seed=0)
    assert env._renderer is not None
    name = env._renderer.opengl_renderer
    env.close()
    return str(name)


def measure(version: str, work_dir: Path, conditions: list[str], num_seeds: int) -> Measured:
    """Run everything under one MuJoCo version, in a virtual environment of its own."""
    folder = (work_dir / version).resolve()
    python = folder / "bin" / "python"
    if not python.exists():
        subprocess.run(["uv", "venv", "-q", "-p", sys.executable, str(folder)], check=True)
    pins = [f"{name}=={importlib.metadata.version(name)}" for name in PACKAGES]
    subprocess.run(["uv", "pip", "install", "-q", "-p", str(python), f"mujoco=={version}", *pins], check=True)
    env = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, SOURCE_ROOTS))}
    command = [str(python), __file__, "--here", f"--seeds={num_seeds}", "--conditions", *conditions]
    # MuJoCo writes its log where it is started
    run = subprocess.run(command, cwd=folder, env=env, check=True, stdout=subprocess.PIPE, text=True)
    return from_dict(json.loads(run.stdout))


def from_dict(figures: dict) -> Measured:
    """Inverse of `asdict`."""
    outcomes = {
        case: Outcome(**outcome) if isinstance(outcome, dict) else outcome
        for case, outcome in figures["outcomes"].items()
    }
    return Measured(figures["mujoco"], figures["renderer"], outcomes)


def table(measured: Sequence[Measured]) -> list[str]:
    """Return Markdown, a row per version and robot; `=` marks a hash equal to the first version's."""
    reference = measured[0]
    conditions = list(dict.fromkeys(case.split()[1] for case in reference.outcomes))
    lines = [
        f"| MuJoCo | robot | states | images | {' | '.join(conditions)} |",
        "|---|---|---|---|" + "---|" * len(conditions),
    ]
    for one in measured:
        for robot in ROBOTS:
            outcomes = [one.outcomes[f"{robot} {condition}"] for condition in conditions]
            expected = [reference.outcomes[f"{robot} {condition}"] for condition in conditions]
            hashes = [_hash(outcomes, kind, expected) for kind in ("states", "images")]
            lines.append(f"| {' | '.join([one.mujoco, robot, *hashes, *map(_outcome_text, outcomes)])} |")
    return lines


def _hash(outcomes: list[Outcome | str], kind: str, expected: list[Outcome | str]) -> str:
    digests, wanted = ([getattr(one, kind, "") for one in some] for some in (outcomes, expected))
    if not any(digests):
        return ""
    short = hashlib.sha256("".join(digests).encode()).hexdigest()[:HASH_DIGITS]
    return f"{short} =" if digests == wanted else short


def _outcome_text(outcome: Outcome | str) -> str:
    if isinstance(outcome, str):
        return "cannot run"
    return f"{outcome.successes}/{outcome.episodes}, {outcome.worst_error_mm:.1f} mm"


def main() -> None:
    """Run the benchmark from the command line."""
    parser = make_parser(__doc__)
    parser.add_argument("versions", nargs="*", help="of MuJoCo; the others are compared with the first")
    parser.add_argument("--seeds", type=int, default=NUM_SEEDS, help=f"episodes a case, from {FIRST_SEED} on")
    parser.add_argument("--conditions", nargs="+", default=CONDITIONS, help="as none dynamics:5")
    parser.add_argument("--work_dir", type=Path, default=Path("simulators"), help="for the environments")
    parser.add_argument("--here", action="store_true", help="measure this Python alone and print JSON")
    parser.add_argument("--json", type=writable, help="also write the figures to this file")
    args = parser.parse_args()
    if args.here:
        figures = measure_here(args.conditions, range(FIRST_SEED, FIRST_SEED + args.seeds))
        print(json.dumps(asdict(figures)))
        return
    measured = [measure(version, args.work_dir, args.conditions, args.seeds) for version in args.versions]
    print("\n".join(table(measured)), f"drawn by {measured[0].renderer}", sep="\n")
    write_figures(args.json, {one.mujoco: asdict(one) for one in measured})


if __name__ == "__main__":
    main()
