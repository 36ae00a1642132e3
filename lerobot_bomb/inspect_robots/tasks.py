"""BOMB's suites as tasks of Inspect Robots: an episode is a scene."""

from dataclasses import replace
from functools import partial
from typing import Any

from inspect_robots.scene import Scene, Target
from inspect_robots.task import Task

from lerobot_bomb.bomb.episode import DEFAULT_FPS, TEST_SEEDS, EpisodeSpec
from lerobot_bomb.bomb.perturbations import Condition
from lerobot_bomb.bomb.suite import find_suite, specs_of_tasks
from lerobot_bomb.conditions import NONE
from lerobot_bomb.inspect_robots import config_errors

EPISODE = "bomb_episode"  # kind of a scene's target, of which the embodiment makes its spec
DEFAULT_EPISODES = 20


def make_task(
    suite: str,
    perturbations: str | None = NONE,
    episodes: int = DEFAULT_EPISODES,
    seed: int = TEST_SEEDS[0],
    task_id: int | None = None,
) -> Task:
    """Return a suite under one or several conditions; each seed is run under all of them.

    A scene's instruction is the unperturbed one; an observation has the one that is given. Success is that of
    BOMB's judge: Inspect Robots' scorer ``success_at_end``.

    Args:
        suite: its name.
        perturbations: conditions, with commas between them: "none,camera:3", "all:1-5".
        episodes: of each condition.
        seed: of the first one; the others count up.
        task_id: number of a task of the suite; None: drawn for each episode.

    Raises:
        ConfigError: a value is not allowed.
    """
    with config_errors():
        if episodes < 1:
            raise ValueError(f"episodes={episodes} must be at least 1")
        task_ids = [] if task_id is None else [task_id]
        (spec,) = specs_of_tasks(EpisodeSpec(seed=seed, suite=suite), task_ids)
        conditions = Condition.groups((perturbations or NONE).split(","), suite)
        scenes = [
            _scene(f"{key}-{each}", replace(spec, seed=each, perturbations=str(condition)), task_ids)
            for key, condition in conditions.items()
            for each in range(seed, seed + episodes)
        ]
    return Task(
        name=f"bomb/{suite}",
        scenes=scenes,
        scorer=["success_at_end", "episode_length"],
        max_seconds=find_suite(suite).max_steps / DEFAULT_FPS,
        metadata={
            "conditions": [str(each) for each in conditions.values()],
            "task_version": find_suite(suite).version,
        },
    )


def _scene(name: str, spec: EpisodeSpec, task_ids: list[int]) -> Scene:
    episode: dict[str, Any] = {
        "suite": spec.suite,
        "seed": spec.seed,
        "perturbations": spec.perturbations,
        "task_ids": task_ids,
    }
    instruction = find_suite(spec.suite).sample(spec).instruction
    return Scene(id=name, instruction=instruction, target=Target(EPISODE, episode), init_seed=spec.seed)


goal, long, place, spatial = (partial(make_task, name) for name in ("goal", "long", "place", "spatial"))
objects = partial(make_task, "object")
