"""A checkpoint that acts in one environment, loaded and called as lerobot-eval does it."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig, make_env_pre_post_processors, preprocess_observation
from lerobot.policies import make_policy
from lerobot.utils.constants import ACTION, OBS_STATE
from lerobot.utils.random_utils import set_seed

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import ACTION_DIM, STATE_DIM, RenderOptions
from lerobot_bomb.checkpoints.adapters import check_adapters
from lerobot_bomb.checkpoints.folder import autocast, load_processors, read_config
from lerobot_bomb.envs.rollout import Agent

ENV_TYPE = "bomb"


def checkpoint_agent(
    path: Path,
    device: str | None,
    spec: EpisodeSpec,
    options: RenderOptions,
    ignore_environment: bool = False,
) -> Agent:
    """Load the folder `pretrained_model` of a checkpoint; `device` None means the checkpoint's own.

    Raises:
        ValueError: the folder holds no checkpoint, one whose action or state is not BOMB's, or one that was
            trained for another environment.
    """
    config = _read_config(path, device)
    if config.use_peft:
        check_adapters(str(path), None)
    env_config = _env_config(spec, options, ignore_environment)
    set_seed(spec.seed)
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


def _read_config(path: Path, device: str | None) -> PreTrainedConfig:
    config = read_config(path, device)
    features = {**(config.input_features or {}), **(config.output_features or {})}
    for name, shape in ((ACTION, (ACTION_DIM,)), (OBS_STATE, (STATE_DIM,))):
        if name in features and tuple(features[name].shape) != shape:
            raise ValueError(
                f"--policy.path={path} is a checkpoint whose {name} has shape {tuple(features[name].shape)}; "
                f"BOMB's has {shape}"
            )
    return config


def _env_config(spec: EpisodeSpec, options: RenderOptions, ignore_environment: bool) -> EnvConfig:
    """LeRobot's view of the environment: what its factories ask about features."""
    return EnvConfig.get_choice_class(ENV_TYPE)(
        task=spec.suite,
        robot=spec.robot,
        control_mode=spec.control_mode,
        fps=spec.fps,
        image_size=options.image_size,
        depth=options.depth,
        ignore_checkpoint=ignore_environment,
    )


def _batch_of_one(values: Any) -> Any:
    """Arrays in nested dicts, each with a first axis of one: what a vector environment gives."""
    if isinstance(values, dict):
        return {key: _batch_of_one(value) for key, value in values.items()}
    return np.asarray(values)[None]
