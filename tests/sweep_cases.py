"""Small sweeps that several test modules use."""

import json
from pathlib import Path

from lerobot_bomb.commands.main import main
from lerobot_bomb.sweep.manifest import Job, Manifest, plan

FLAGS = ("--env.type=bomb", "--env.image_size=32", "--policy.device=cpu")
NANO = "bomb:vla0_smol"


def small(
    policies: tuple[str, ...] = ("bomb_expert",), conditions: tuple[str, ...] = ("none",), n: int = 3
) -> Manifest:
    return plan(policies, ("place",), conditions, seed=7, num_episodes=n, batch_size=10, flags=FLAGS)


def lines_of(job: Job) -> list[str]:
    """Return as many lines as the job has episodes."""
    return [json.dumps({"spec": {"seed": seed}}) for seed in job.seeds]


def sweep(*flags: str | Path) -> int:
    return main(["sweep", *map(str, flags)])
