"""A policy that acts in an environment, loaded and called as lerobot-eval does it."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs import (
    EnvConfig,
    env_to_policy_features,
    make_env_pre_post_processors,
    preprocess_observation,
)
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_STATE
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.random_utils import get_rng_state, set_rng_state, set_seed

from lerobot_bomb.bomb.scripted_policy import ScriptedConfig
from lerobot_bomb.checkpoints.acting import acting
from lerobot_bomb.checkpoints.adapters import check_adapters
from lerobot_bomb.checkpoints.folder import (
    Postprocessor,
    Preprocessor,
    autocast,
    load_processors,
    read_config,
)
from lerobot_bomb.envs.rollout import BatchAgent


class LoadedPolicy:
    """A policy, with the processors between it and an environment."""

    def __init__(
        self,
        config: PreTrainedConfig,
        env_config: EnvConfig,
        seed: int,
        make_processors: Callable[[PreTrainedConfig], tuple[Preprocessor, Postprocessor]],
    ):
        set_seed(seed)
        self.config = config
        self.policy = make_policy(cfg=config, env_cfg=env_config)
        self.policy.eval()
        self.policy.reset()
        self._random_state = get_rng_state()
        self.prepare, self.postprocess = make_processors(config)
        with acting(config):
            self._env_processors = make_env_pre_post_processors(env_cfg=env_config, policy_cfg=config)

    def begin(self, first_episode: int = 0) -> None:
        """Start a batch of episodes with the random state of the first one, and noise of these numbers on."""
        set_rng_state(self._random_state)
        # of our own types
        reset_to: Callable[[int], None] | None = getattr(self.policy, "reset_to", None)
        if reset_to is None:
            self.policy.reset()
        else:
            reset_to(first_episode)

    def observe(self, observations: list[dict[str, Any]], instructions: list[str]) -> dict[str, Any]:
        """Return the input of `prepare`: images (B, 3, H, W) in [0, 1] by camera, state, task."""
        batch = {**preprocess_observation(_stacked(observations)), "task": instructions}
        return self._env_processors[0](batch)

    def act(self, batch: dict[str, Any]) -> np.ndarray:
        """Return (B, D) actions of the environment, for the output of `prepare`."""
        with torch.inference_mode(), autocast(self.config):
            action = self.postprocess(self.policy.select_action(batch))
        return self._env_processors[1]({ACTION: action})[ACTION].to("cpu").numpy()

    def agent(self, observations: list[dict[str, Any]], instructions: list[str]) -> np.ndarray:
        """(B, D) actions for B environments, as lerobot-eval asks for them."""
        with torch.inference_mode():
            batch = self.prepare(self.observe(observations, instructions))
        return self.act(batch)


def load_policy(
    path: Path,
    device: str | None,
    env_type: str,
    env_flags: dict[str, Any],
    seed: int,
    policy_flags: Sequence[str] = (),
) -> LoadedPolicy:
    """Load the folder `pretrained_model` of a checkpoint; `device` None means the checkpoint's own.

    `policy_flags` change other values of its config: "--n_action_steps=4".

    Raises:
        ValueError: the folder holds no checkpoint, one whose action or state is not the environment's, or one
            that was trained for another environment.
    """
    config = read_config(path, device, policy_flags)
    env_config: EnvConfig = EnvConfig.get_choice_class(env_type)(**env_flags)
    _check_shapes(path, config, env_config)
    if config.use_peft:
        check_adapters(str(path), None)
    return LoadedPolicy(config, env_config, seed, load_processors)


def scripted_agent(policy_type: str, env_type: str, env_flags: dict[str, Any], seed: int) -> BatchAgent:
    """Build a policy without weights from its type.

    Raises:
        ValueError: the type has weights, which would be random ones.
    """
    register_third_party_plugins()
    config = PreTrainedConfig.get_choice_class(policy_type)()
    if not isinstance(config, ScriptedConfig):
        raise ValueError(f"{policy_type} was built with random weights, which are in no file")
    env_config: EnvConfig = EnvConfig.get_choice_class(env_type)(**env_flags)
    return LoadedPolicy(config, env_config, seed, make_pre_post_processors).agent


def _check_shapes(path: Path, config: PreTrainedConfig, env_config: EnvConfig) -> None:
    of_env = env_to_policy_features(env_config)
    features = {**(config.input_features or {}), **(config.output_features or {})}
    for name in (ACTION, OBS_STATE):
        if name in features and features[name].shape != of_env[name].shape:
            raise ValueError(
                f"--policy.path={path} is a checkpoint whose {name} has shape {tuple(features[name].shape)}; "
                f"that of --env.type={env_config.type} has {of_env[name].shape}"
            )


def _stacked(rows: list[Any]) -> Any:
    """Stack arrays in nested dicts along a first axis, as a vector environment does."""
    if isinstance(rows[0], dict):
        return {key: _stacked([row[key] for row in rows]) for key in rows[0]}
    return np.stack(rows)
