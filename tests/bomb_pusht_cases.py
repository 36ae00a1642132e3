"""Cases that the tests of `bomb_pusht` have in common."""

from dataclasses import asdict
from typing import Any

import numpy as np

from lerobot_bomb.pusht.episode import PushTSpec
from lerobot_bomb.pusht.perturbations import PushTCondition
from lerobot_bomb.results.pusht import PushTResult


def pushing_actions(seed: int, block_xy: np.ndarray, num: int) -> np.ndarray:
    """(num, 2) float32 targets that lead across the block and elsewhere, the same for the same seed."""
    rng = np.random.default_rng(seed)
    across = np.clip(block_xy + rng.uniform(-90, 90, (num, 2)), 0, 512)
    anywhere = rng.uniform(0, 512, (num, 2))
    return np.where(np.arange(num)[:, None] % 4 < 3, across, anywhere).astype(np.float32)


def pusht_env(condition: str = "none", **kwargs: Any) -> Any:
    """An environment of this condition; a PushTSpec's other fields and the environment's own by name."""
    from lerobot_env_bomb.pusht.env import BombPushTEnv

    of_spec = {name: kwargs.pop(name) for name in ("instruction", "max_steps") if name in kwargs}
    return BombPushTEnv(PushTSpec(0, perturbations=condition, **of_spec), **kwargs)


def run(env: Any, seed: int, num: int) -> list[dict[str, np.ndarray]]:
    """Pictures, poses and rewards of an episode of `num` steps, which an episode's seed determines."""
    observation, info = env.reset(seed=seed)
    actions = pushing_actions(seed, info["block_pose"][:2], num)
    moments = [seen(observation, info, 0.0)]
    for action in actions:
        observation, reward, _, _, info = env.step(action)
        moments.append(seen(observation, info, reward))
    return moments


def seen(observation: dict[str, np.ndarray], info: dict[str, Any], reward: float) -> dict[str, np.ndarray]:
    """Return what a moment of an episode shows and is."""
    return {
        "pixels": observation["pixels"],
        "agent_pos": observation["agent_pos"],
        "block_pose": info["block_pose"],
        "goal_pose": info["goal_pose"],
        "reward": np.array(reward),
    }


def pusht_row(seed: int, condition: str, max_coverage: float, failure: str | None) -> dict[str, Any]:
    """A record, read back."""
    result = PushTResult(
        spec=PushTSpec(seed, "none", perturbations=condition),
        instruction="",
        goal_pose=(256.0, 256.0, 0.785),
        steps=300,
        is_success=failure is None,
        failure=failure,
        coverage=max_coverage if failure is None else max_coverage / 2,
        max_coverage=max_coverage,
        levels={axis: high for axis, _, high in PushTCondition(condition).ranges},
        simulator_versions={"gym-pusht": "0.1.8"},
    )
    return asdict(result)
