"""A checkpoint that acts on images, state and instruction from outside LeRobot, as lerobot-eval calls it."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from lerobot.envs import preprocess_observation
from lerobot.policies import get_policy_class
from lerobot.utils.constants import OBS_IMAGE, OBS_STATE
from lerobot.utils.random_utils import set_seed

from lerobot_bomb.checkpoints.folder import autocast, load_processors, read_config
from lerobot_bomb.checkpoints.shipped import checkpoint_path

EMPTY_CAMERA = "empty_camera"  # what LeRobot's policies call a camera that none delivers: they fill it in


class StandalonePolicy:
    """A policy of one episode at a time: it keeps that episode's state.

    Args:
        checkpoint: the folder that lerobot-train names pretrained_model, or bomb:NAME.
        device: cpu, cuda, ...; None: the checkpoint's own.
        seed: of the policy's random numbers, as --seed of lerobot-eval.
        values: others of its config: {"num_inference_steps": 3}.
        cameras: {camera of the policy: its name in the benchmark}; a camera left out has the same name.
        resize: stretch images to the size that the checkpoint reads; without it, other sizes are refused.

    Raises:
        ValueError: the checkpoint does not exist or holds adapters, or this machine has no such device.
    """

    def __init__(
        self,
        checkpoint: str,
        device: str | None,
        seed: int,
        values: Mapping[str, Any],
        cameras: Mapping[str, str],
        resize: bool,
    ) -> None:
        flags = [f"--{name}={json.dumps(value)}" for name, value in values.items()]
        self.config = config = read_config(Path(checkpoint_path(checkpoint)), device, flags)
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
        # key of the policy -> the benchmark's name
        self.cameras = {
            key: cameras.get(name, name)
            for key in config.image_features
            if not (name := key.rpartition(".")[2]).startswith(EMPTY_CAMERA)
        }
        self._resize = resize

    @property
    def reads_state(self) -> bool:
        """Tell whether the policy reads the robot's state."""
        return self.config.robot_state_feature is not None

    def begin(self) -> None:
        """Begin an episode."""
        self._policy.reset()

    def act(self, images: Mapping[str, np.ndarray], state: Any, instruction: str) -> np.ndarray:
        """Return the next action, (D,) float32 in the units of the checkpoint's data.

        Args:
            images: {the benchmark's camera: (H, W, 3) uint8}.
            state: (S,), or anything where the policy reads none.
            instruction: of this step.

        Raises:
            ValueError: this is not what the policy reads.
        """
        batch = {**self._read_images(images), **self._read_state(state), "task": [instruction]}
        with torch.inference_mode(), autocast(self.config):
            action = self._postprocess(self._policy.select_action(self._preprocess(batch)))
        return action[0].float().cpu().numpy()

    def _read_images(self, sent: Mapping[str, np.ndarray]) -> dict[str, torch.Tensor]:
        """Return {key of the policy: (1, 3, H, W) in [0, 1]}."""
        images = {}
        for key, camera in self.cameras.items():
            if camera not in sent:
                raise ValueError(
                    f"the checkpoint reads {key}, and the benchmark sends the cameras {', '.join(sent)}: "
                    f"give cameras: {{{key.rpartition('.')[2]}: NAME}}"
                )
            image = self._sized(sent[camera], self.config.image_features[key].shape[1:], camera)
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

    def _read_state(self, state: Any) -> dict[str, torch.Tensor]:
        """Return {observation.state: (1, S)}, if the policy reads it."""
        feature = self.config.robot_state_feature
        if feature is None:
            return {}
        if not isinstance(state, np.ndarray) or state.shape != tuple(feature.shape):
            shape, sent = tuple(feature.shape), getattr(state, "shape", "none")
            raise ValueError(f"the checkpoint reads a state of shape {shape}, and the benchmark sends {sent}")
        return {OBS_STATE: torch.from_numpy(state.astype(np.float32))[None]}
