"""BOMB's arm and board as an embodiment of Inspect Robots."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
from inspect_robots.embodiment import PRIVILEGED_SUCCESS, EmbodimentBase, EmbodimentInfo
from inspect_robots.errors import EmbodimentFault
from inspect_robots.scene import Scene
from inspect_robots.types import Action, Observation, StepResult

from lerobot_bomb import __version__
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import AGENT_POS, PIXELS
from lerobot_bomb.bomb.suite import find_suite, specs_of_tasks, task_version
from lerobot_bomb.checkpoints.acting import acting_config
from lerobot_bomb.checkpoints.env_config import decode_env
from lerobot_bomb.checkpoints.environment import check_acting_policy
from lerobot_bomb.checkpoints.identity import policy_of_results
from lerobot_bomb.envs.rollout import ENV_ID
from lerobot_bomb.inspect_robots import config_errors
from lerobot_bomb.inspect_robots.spaces import action_box, notes, observed_space
from lerobot_bomb.inspect_robots.tasks import EPISODE
from lerobot_bomb.results.origin import PolicyIdentity
from lerobot_bomb.results.writing import check_results_path

OF_TASK = ("task", "task_ids", "perturbations")  # flags that a scene decides


class BombEmbodiment(EmbodimentBase):
    """Plays the scenes of BOMB's tasks: a scene is an episode, the same in every epoch.

    Args:
        flags: those of --env.type=bomb but for `depth` and those of the task, by name. Without `image_size`,
            images have the size that the checkpoint reads which this process has loaded, else 256 pixels.

    Raises:
        ConfigError: a flag is unknown or has a value that is not allowed.
    """

    def __init__(self, **flags: Any) -> None:
        with config_errors():
            self._config: Any = _read_config(flags)
        config = self._config
        self.info = EmbodimentInfo(
            name="bomb",
            action_space=action_box(config.control_mode),
            observation_space=observed_space(config.render_options.image_size),
            control_hz=config.fps,
            is_simulated=True,
            capabilities=frozenset({PRIVILEGED_SUCCESS}),
            supported_target_kinds=frozenset({EPISODE}),
            docs=notes(config.control_mode),
            environment_id=f"{config.simulator}, {config.robot}",
            environment_revision=f"lerobot_policy_bomb {__version__}",
        )
        self._env: gymnasium.Env | None = None
        self._made_for: tuple[EpisodeSpec, dict[str, PolicyIdentity]] | None = None  # what `_env` is of
        self._trial: tuple[gymnasium.Env, int, int | None] | None = None  # env, episode's seed, trial's seed

    def reset(self, scene: Scene, *, seed: int | None = None) -> Observation:
        """Start a scene's episode, whose seed is its own: `seed` changes nothing.

        Raises:
            EmbodimentFault: the scene has no episode of BOMB, no episode can be drawn from the flags, the
                policy that acts was trained for another environment, or a second epoch would replace the
                records of the first.
        """
        if scene.target is None or scene.target.kind != EPISODE:
            raise EmbodimentFault(f"scene {scene.id!r} is none of BOMB: give --task bomb/SUITE")
        episode = scene.target.spec
        try:
            env = self._env_of(self._spec_of(episode))
        except ValueError as error:
            raise EmbodimentFault(str(error)) from None
        self._begin_trial(scene, (env, episode["seed"], seed))
        observation, _ = env.reset(seed=episode["seed"])
        return self._observe(observation)

    def step(self, action: Action) -> StepResult:
        assert self._env is not None
        command = np.asarray(action.data, dtype=np.float32)
        observation, reward, terminated, truncated, info = self._env.step(command)
        reason = ("success" if info["is_success"] else info["failure"]) if terminated else None
        return StepResult(self._observe(observation), float(reward), terminated, reason, truncated, info)

    def close(self) -> None:
        if self._env is not None:
            self._env.close()
            self._env = None

    def _spec_of(self, episode: Mapping[str, Any]) -> EpisodeSpec:
        """Return a scene's spec, without its seed."""
        (spec,) = self._config.specs_of(episode["suite"])
        (spec,) = specs_of_tasks(spec, episode["task_ids"])
        find_suite(spec.suite).check(spec)
        return replace(spec, perturbations=episode["perturbations"])

    def _env_of(self, spec: EpisodeSpec) -> gymnasium.Env:
        """Return the environment of a spec, which names the policy that acts now in its records."""
        config, suite = self._config, spec.suite
        if not config.ignore_checkpoint:
            check_acting_policy(replace(config.environment, task=suite, task_version=task_version(suite)))
        (policy,) = policy_of_results(config.results_path, 1)
        if self._env is None or self._made_for != (spec, policy):
            self.close()
            kwargs = config.gym_kwargs | policy | {"spec": spec}
            self._env = gymnasium.make(ENV_ID.format(suite=suite), disable_env_checker=True, **kwargs)
            self._made_for = spec, policy
        return self._env

    def _begin_trial(self, scene: Scene, trial: tuple[gymnasium.Env, int, int | None]) -> None:
        """Note a trial; refuse an epoch after the first, whose seed alone differs, if records are kept."""
        before, self._trial = self._trial, trial
        path = self._config.results_path
        if path is not None and before is not None and before[:2] == trial[:2] and before != trial:
            raise EmbodimentFault(
                f"scene {scene.id!r} in a second epoch: of an episode that is run again, only the last "
                f"record in {path} counts; use --epochs=1 and more episodes, or leave out -E results_path"
            )

    def _observe(self, observation: dict[str, Any]) -> Observation:
        assert self._env is not None
        state = observation[AGENT_POS]
        return Observation(
            images=observation[PIXELS],
            state={AGENT_POS: state, "eef_pos": state[:3], "gripper_width": state[3:]},
            instruction=self._env.get_wrapper_attr("task_description"),
        )


def _read_config(flags: dict[str, Any]) -> Any:
    """Read the config of ``--env.type=bomb`` with LeRobot's parser."""
    for name in OF_TASK:
        if name in flags:
            raise ValueError(f"{name} is the task's: --task bomb/SUITE -T perturbations=..., -T task_id=...")
    if flags.get("depth"):
        raise ValueError("depth=true: an observation of Inspect Robots has no depth; use lerobot-eval")
    if flags.get("control_mode") == "joints":
        raise ValueError("control_mode=joints: a state of Inspect Robots is the gripper's; use lerobot-eval")
    config: Any = decode_env({"type": "bomb", **flags})
    config.take_image_size(acting_config())
    check_results_path(config.results_path)
    return config
