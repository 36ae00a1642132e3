"""Records of LeRobot's own environments, from the eval_info.json that lerobot-eval writes."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from math import isfinite
from typing import Any

import draccus
from lerobot.configs import FeatureType
from lerobot.envs import EnvConfig

from lerobot_bomb.environments import env_type
from lerobot_bomb.results.origin import NOT_RECORDED, PolicyIdentity, installed_versions
from lerobot_bomb.results.stock import FAILED, StockResult, StockSpec

EVAL_INFO = "eval_info.json"  # in the folder of --output_dir
# fields of an environment's config that do not decide what an episode is, or that its spec says
NOT_SETTINGS = {
    "type", "features", "features_map", "render_mode", "visualization_width", "visualization_height",
    "disable_env_checker", "max_parallel_tasks", "task_ids",
}  # fmt: skip


def results_of(
    info: Mapping[str, Any],
    env: EnvConfig,
    policy: PolicyIdentity,
    seed: int,
    batch_size: int,
    first: int = 0,
) -> Iterator[StockResult]:
    """Yield the result of each episode, in the order of tasks and seeds.

    Args:
        info: contents of lerobot-eval's eval_info.json.
        env: the environment's flags.
        policy: who acted.
        seed: of the first episode.
        batch_size: episodes that were run at once.
        first: number of the first episode, where it was run alone out of a longer evaluation.

    Raises:
        ValueError: an episode's rewards are not finite: its actions or the simulation were not.
    """
    record_type = env_type(env.type).record
    settings = _settings(env, record_type)
    for task in info["per_task"]:
        metrics = task["metrics"]
        episodes = zip(metrics["sum_rewards"], metrics["max_rewards"], metrics["successes"], strict=True)
        for i, (sum_reward, max_reward, is_success) in enumerate(episodes):
            if not (isfinite(sum_reward) and isfinite(max_reward)):
                raise ValueError(f"the rewards of seed {seed + i} are not finite")
            number = first + i if record_type.starts_by_number else None
            yield record_type(
                spec=StockSpec(seed + i, task["task_group"], task["task_id"], number),
                sum_reward=sum_reward,
                max_reward=max_reward,
                is_success=is_success,
                failure=None if is_success else FAILED,
                image_size=record_type.drawn_size or _image_size(env),
                flags=settings,
                simulator_versions=installed_versions(record_type.simulator),
                policy=replace(policy, batch_size=batch_size, batch_row=i % batch_size),
            )


def _settings(env: EnvConfig, record_type: type[StockResult]) -> dict[str, Any]:
    of_spec = {"task"} if record_type.starts_by_number else set()
    values: Any = draccus.encode(env)
    return {name: value for name, value in values.items() if name not in NOT_SETTINGS | of_spec}


def _image_size(env: EnvConfig) -> str:
    """Width and height of the first camera's images, as '640x480'."""
    sizes = [each.shape[:2] for each in env.features.values() if each.type is FeatureType.VISUAL]
    return "{1}x{0}".format(*sizes[0]) if sizes else NOT_RECORDED
