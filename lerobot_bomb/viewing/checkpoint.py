"""A checkpoint that acts in one environment, loaded and called as lerobot-eval does it."""

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
from lerobot.policies import make_policy
from lerobot.utils.constants import ACTION, OBS_STATE
from lerobot.utils.random_utils import set_seed

from lerobot_bomb.checkpoints.adapters import check_adapters
from lerobot_bomb.checkpoints.folder import autocast, load_processors, read_config
from lerobot_bomb.envs.rollout import Agent


def checkpoint_agent(
    path: Path, device: str | None, env_type: str, env_flags: dict[str, Any], seed: int
) -> Agent:
    """Load the folder `pretrained_model` of a checkpoint; `device` None means the checkpoint's own.

    Raises:
        ValueError: the folder holds no checkpoint, one whose action or state is not the environment's, or one
            that was trained for another environment.
    """
    config = read_config(path, device)
    env_config: EnvConfig = EnvConfig.get_choice_class(env_type)(**env_flags)
    _check_shapes(path, config, env_config)
    if config.use_peft:
        check_adapters(str(path), None)
    set_seed(seed)
    policy = make_policy(cfg=config, env_cfg=env_config)
    policy.eval()
    policy.reset()
    preprocess, postprocess = load_processors(config)
    env_preprocess, env_postprocess = make_env_pre_post_processors(env_cfg=env_config, policy_cfg=config)

    def act(observation: dict[str, Any], instruction: str) -> np.ndarray:
        batch = {**preprocess_observation(_batch_of_one(observation)), "task": [instruction]}
        with torch.inference_mode(), autocast(config):
            action = postprocess(policy.select_action(preprocess(env_preprocess(batch))))
        return env_postprocess({ACTION: action})[ACTION].to("cpu").numpy()[0]

    return act


def _check_shapes(path: Path, config: PreTrainedConfig, env_config: EnvConfig) -> None:
    of_env = env_to_policy_features(env_config)
    features = {**(config.input_features or {}), **(config.output_features or {})}
    for name in (ACTION, OBS_STATE):
        if name in features and features[name].shape != of_env[name].shape:
            raise ValueError(
                f"--policy.path={path} is a checkpoint whose {name} has shape {tuple(features[name].shape)}; "
                f"that of --env.type={env_config.type} has {of_env[name].shape}"
            )


def _batch_of_one(values: Any) -> Any:
    """Arrays in nested dicts, each with a first axis of one: what a vector environment gives."""
    if isinstance(values, dict):
        return {key: _batch_of_one(value) for key, value in values.items()}
    return np.asarray(values)[None]
