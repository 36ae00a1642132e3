"""A checkpoint of LeRobot as a model server of vla-eval, loaded and called as lerobot-eval does it."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from lerobot.envs import preprocess_observation
from lerobot.policies import get_policy_class
from lerobot.utils.constants import OBS_IMAGE, OBS_STATE
from lerobot.utils.random_utils import set_seed
from vla_eval.model_servers.base import SessionContext
from vla_eval.model_servers.predict import PredictModelServer
from vla_eval.specs import IMAGE_RGB, LANGUAGE, RAW, DimSpec
from vla_eval.types import Action, Observation

from lerobot_bomb.bomb.environment import Environment
from lerobot_bomb.bomb.episode import TEST_SEEDS
from lerobot_bomb.checkpoints.acting import acting
from lerobot_bomb.checkpoints.environment import check_acting_policy
from lerobot_bomb.checkpoints.folder import autocast, load_processors, read_config
from lerobot_bomb.checkpoints.shipped import checkpoint_path
from lerobot_bomb.harness.benchmark import ENVIRONMENT

EMPTY_CAMERA = "empty_camera"  # what LeRobot's policies call a camera that none delivers: they fill it in


class CheckpointServer(PredictModelServer):
    """Runs one episode at a time, an action per observation.

    A policy keeps the state of one episode (queue of actions, ensemble, past observations, noise). So another
    session's observations are refused until the episode has ended: each shard needs its own server. An
    observation has ``images`` {camera: (H, W, 3) uint8}, ``states`` or ``state`` (S,) and
    ``task_description``; an answer has ``actions`` (D,) float32, in the units of the checkpoint's data.

    Args:
        checkpoint: the folder that lerobot-train names pretrained_model, or bomb:NAME.
        device: cpu, cuda, ...; null: the checkpoint's own.
        seed: of the policy's random numbers, as --seed of lerobot-eval.
        policy: other values of its config, as the flags --policy.NAME of lerobot-eval.
        cameras: {camera of the policy: its name in the benchmark}; a camera left out has the same name.
        resize: stretch images to the size that the checkpoint reads; without it, other sizes are refused.
        observation_params: parameters for the benchmark, so that it sends what this policy reads.

    Raises:
        ValueError: the checkpoint does not exist or holds adapters, or this machine has no such device.
    """

    def __init__(
        self,
        checkpoint: str,
        device: str | None = None,
        seed: int = TEST_SEEDS[0],
        policy: dict[str, Any] | None = None,
        cameras: dict[str, str] | None = None,
        resize: bool = False,
        observation_params: dict[str, Any] | None = None,
    ) -> None:
        super().__init__()
        flags = [f"--{name}={json.dumps(value)}" for name, value in (policy or {}).items()]
        self._config = config = read_config(Path(checkpoint_path(checkpoint)), device, flags)
        if config.use_peft:
            raise ValueError(
                f"{checkpoint} holds adapters; lerobot-bomb checkpoint merge makes a whole one of them"
            )
        set_seed(seed)
        self._policy = get_policy_class(config.type).from_pretrained(
            str(config.pretrained_path), config=config
        )
        self._policy.to(str(config.device)).eval()
        self._preprocess, self._postprocess = load_processors(config)
        self._cameras = {
            key: (cameras or {}).get(name, name)
            for key in config.image_features
            if not (name := key.rpartition(".")[2]).startswith(EMPTY_CAMERA)
        }
        self._resize = resize
        self._observation_params = observation_params or {}
        self._episode: SessionContext | None = None  # the one under way
        self._environment: Environment | None = None  # where it acts, if that is BOMB

    def get_observation_params(self) -> dict[str, Any]:
        return self._observation_params

    def get_action_spec(self) -> dict[str, DimSpec]:
        return {}  # an action means what it meant in the checkpoint's data, which no config says

    def get_observation_spec(self) -> dict[str, DimSpec]:
        state = {} if self._config.robot_state_feature is None else {"state": RAW}
        return {**dict.fromkeys(self._cameras.values(), IMAGE_RGB), "language": LANGUAGE, **state}

    async def on_episode_start(self, config: dict[str, Any], ctx: SessionContext) -> None:
        await super().on_episode_start(config, ctx)
        if self._episode is None or self._episode.session_id == ctx.session_id:
            self._episode = ctx
            environment = config["task"].get(ENVIRONMENT)
            self._environment = None if environment is None else Environment(**json.loads(environment))

    async def on_episode_end(self, result: dict[str, Any], ctx: SessionContext) -> None:
        await super().on_episode_end(result, ctx)
        if self._episode is ctx:
            self._episode = None

    def predict(self, obs: Observation, ctx: SessionContext) -> Action:
        """Return the next action of the episode.

        Raises:
            ValueError: the observation is not what the policy reads, or the policy was trained for another
                BOMB.
            RuntimeError: another session's episode is under way.
        """
        if ctx is not self._episode:
            raise RuntimeError("this server runs another session's episode; start a server for each shard")
        if ctx.is_first:
            if self._environment is not None:
                with acting(self._config):
                    check_acting_policy(self._environment)
            self._policy.reset()
        batch = {**self._read_images(obs), **self._read_state(obs), "task": [obs.get("task_description", "")]}
        with torch.inference_mode(), autocast(self._config):
            action = self._postprocess(self._policy.select_action(self._preprocess(batch)))
        return {"actions": action[0].float().cpu().numpy()}

    def _read_images(self, obs: Observation) -> dict[str, torch.Tensor]:
        """Return {key of the policy: (1, 3, H, W) in [0, 1]}."""
        sent = obs.get("images", {})
        images = {}
        for key, camera in self._cameras.items():
            if camera not in sent:
                raise ValueError(
                    f"the checkpoint reads {key}, and the benchmark sends the cameras {', '.join(sent)}: "
                    f"give cameras: {{{key.rpartition('.')[2]}: NAME}}"
                )
            image = self._sized(sent[camera], self._config.image_features[key].shape[1:], camera)
            images[key] = preprocess_observation({"pixels": image})[OBS_IMAGE]
        return images

    def _sized(self, image: np.ndarray, size: tuple[int, ...], camera: str) -> np.ndarray:
        """Return the image at this height and width; raise a ValueError if it may not be resized."""
        if image.shape[:2] == size:
            return image
        (height, width), (sent_height, sent_width) = size, image.shape[:2]
        if not self._resize:
            raise ValueError(
                f"the checkpoint reads images of {width}x{height} pixels, and those of the camera {camera} "
                f"have {sent_width}x{sent_height}: change the benchmark's image_size, or give resize: true"
            )
        return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)

    def _read_state(self, obs: Observation) -> dict[str, torch.Tensor]:
        """Return {observation.state: (1, S)}, if the policy reads it."""
        feature = self._config.robot_state_feature
        if feature is None:
            return {}
        state = obs.get("states", obs.get("state"))
        if not isinstance(state, np.ndarray) or state.shape != tuple(feature.shape):
            sent = state.shape if isinstance(state, np.ndarray) else "none"
            raise ValueError(
                f"the checkpoint reads a state of shape {tuple(feature.shape)}, and the benchmark sends "
                f"{sent}; many send it with observation_params: {{send_state: true}}"
            )
        return {OBS_STATE: torch.from_numpy(state.astype(np.float32))[None]}
