"""BOMB as a benchmark of vla-eval: the episodes of ``lerobot-eval --env.type=bomb``."""

import json
from dataclasses import asdict
from typing import Any

import gymnasium
import numpy as np
from vla_eval.benchmarks.base import StepBenchmark, StepResult
from vla_eval.specs import IMAGE_RGB, LANGUAGE, DimSpec
from vla_eval.types import Action, EpisodeResult, Observation, Task

from lerobot_bomb.bomb.episode import TEST_SEEDS, EpisodeSpec
from lerobot_bomb.bomb.observation import ACTION_NAMES, AGENT_POS, CAMERAS, PIXELS, state_names
from lerobot_bomb.checkpoints.env_config import decode_env
from lerobot_bomb.envs.rollout import ENV_ID
from lerobot_bomb.results.writing import check_results_path

ENVIRONMENT = "bomb_environment"  # of a task: `Environment` as JSON, for a server that knows what it needs


class BombBenchmark(StepBenchmark):
    """BOMB with the flags of ``--env.type=bomb``.

    A task is a suite under a condition, named like its group in `lerobot-eval` ("place.camera-3"). Each of
    `task_ids` makes a task of its own ("place.camera-3.12"). An observation has ``images`` {camera: (H, W, 3)
    uint8}, ``states`` (4,) float32 in metres and ``task_description``; an action has ``actions`` (4,). Units
    are those of `lerobot_bomb.bomb.observation`.

    Args:
        seed: of each task's first episode; the next ones have the next seeds.
        flags: those of ``--env.type=bomb`` but for `depth`, by name.

    Raises:
        ValueError: a flag is unknown or has a value that is not allowed.
    """

    def __init__(self, seed: int = TEST_SEEDS[0], **flags: Any) -> None:
        super().__init__()
        self._seed = seed
        self._config = _env_config(flags)
        check_results_path(self._config.results_path)
        self._specs: dict[str, EpisodeSpec] = {
            key if self._config.task_ids is None else f"{key}.{task_id}": spec
            for key, specs in self._config.groups.items()
            for task_id, spec in specs.items()
        }
        self._env: gymnasium.Env | None = None
        self._name = ""  # of the task that `_env` is of

    def get_tasks(self) -> list[Task]:
        checked = {ENVIRONMENT: json.dumps(asdict(self._config.environment))}
        checked = {} if self._config.ignore_checkpoint else checked
        return [{"name": name, "suite": spec.suite, **checked} for name, spec in self._specs.items()]

    def reset(self, task: Task) -> dict[str, Any]:
        if self._env is None or self._name != task["name"]:
            self.cleanup()
            spec, self._name = self._specs[task["name"]], task["name"]
            kwargs = self._config.gym_kwargs | {"spec": spec}
            self._env = gymnasium.make(ENV_ID.format(suite=spec.suite), disable_env_checker=True, **kwargs)
        observation, _ = self._env.reset(seed=self._seed + task["episode_idx"])
        self._recorder.record_video(observation[PIXELS][CAMERAS[0]])
        return observation

    def step(self, action: Action) -> StepResult:
        assert self._env is not None
        observation, reward, terminated, truncated, info = self._env.step(np.asarray(action["actions"]))
        self._recorder.record_video(observation[PIXELS][CAMERAS[0]])
        return StepResult(observation, float(reward), terminated or truncated, info)

    def make_obs(self, raw_obs: dict[str, Any], task: Task) -> Observation:
        assert self._env is not None
        return {
            "images": raw_obs[PIXELS],
            "states": raw_obs[AGENT_POS],
            "task_description": self._env.get_wrapper_attr("task_description"),
        }

    def get_step_result(self, step_result: StepResult) -> EpisodeResult:
        info = step_result.info
        names = ("seed", "progress", "placement_error_mm", "failure")
        return {"success": info["is_success"], **{name: info[name] for name in names}}

    def get_metric_keys(self) -> dict[str, str]:
        return {"success": "mean", "progress": "mean", "placement_error_mm": "mean"}

    def get_metadata(self) -> dict[str, Any]:
        return {"max_steps": None}  # the environment ends its episodes

    def get_action_spec(self) -> dict[str, DimSpec]:
        names = ACTION_NAMES[self._config.control_mode]
        return {"actions": DimSpec("actions", len(names), "raw", description=", ".join(names))}

    def get_observation_spec(self) -> dict[str, DimSpec]:
        cameras = dict.fromkeys(CAMERAS, IMAGE_RGB)
        dims = len(state_names(self._config.control_mode))
        return {**cameras, "language": LANGUAGE, "state": DimSpec("state", dims, "raw")}

    def cleanup(self) -> None:
        if self._env is not None:
            self._env.close()
            self._env = None


def _env_config(flags: dict[str, Any]) -> Any:
    """Read the config of ``--env.type=bomb`` with LeRobot's parser."""
    if flags.get("depth"):
        raise ValueError("depth: true: an observation of the harness has no depth; use lerobot-eval")
    return decode_env({"type": "bomb", **flags})
