"""A LeRobot checkpoint as a policy of Inspect Robots."""

from typing import Any

import numpy as np
from inspect_robots.policy import PolicyBase, PolicyConfig, PolicyInfo
from inspect_robots.scene import Scene
from inspect_robots.spaces import Box, CameraSpec, ObservationSpace
from inspect_robots.types import Action, ActionChunk, Observation
from lerobot.utils.constants import ACTION

from lerobot_bomb.bomb.episode import TEST_SEEDS
from lerobot_bomb.bomb.observation import AGENT_POS
from lerobot_bomb.checkpoints.environment import trained_environment
from lerobot_bomb.checkpoints.identity import identity_of_config
from lerobot_bomb.checkpoints.standalone import StandalonePolicy
from lerobot_bomb.inspect_robots import config_errors
from lerobot_bomb.inspect_robots.spaces import action_box


class CheckpointPolicy(PolicyBase):
    """A checkpoint of LeRobot, asked for one action at a time: it executes its own chunks.

    Args:
        checkpoint: the folder that lerobot-train names pretrained_model, or bomb:NAME.
        device: cpu, cuda, ...; None: the checkpoint's own.
        seed: of the policy's random numbers, as --seed of lerobot-eval.
        cameras: the embodiment's names of the policy's cameras where they differ: "image:front,image2:wrist".
        state: the embodiment's state that it reads; several, as "eef_pos,gripper_width", are put side by
            side.
        resize: stretch images to the size that the checkpoint reads.
        values: other values of its config, as the flags --policy.NAME of lerobot-eval.

    Raises:
        ConfigError: the checkpoint does not exist or holds adapters, or a value is not allowed.
    """

    def __init__(
        self,
        checkpoint: str,
        device: str | None = None,
        seed: int = TEST_SEEDS[0],
        cameras: str = "",
        state: str = AGENT_POS,
        resize: bool = False,
        **values: Any,
    ) -> None:
        with config_errors():
            names = _names_of(cameras)
            self._policy = StandalonePolicy(checkpoint, device, seed, values, names, resize)
        self._state = state.split(",") if self._policy.reads_state else []
        config: Any = self._policy.config
        environment = trained_environment(config)
        specs = tuple(
            CameraSpec(name, *config.image_features[key].shape[1:])
            for key, name in self._policy.cameras.items()
        )
        shape = tuple(config.output_features[ACTION].shape)
        self.info = PolicyInfo(
            name=f"{config.type} of {checkpoint}",
            action_space=Box(shape) if environment is None else action_box(environment.control_mode),
            observation_space=ObservationSpace(specs, frozenset(self._state)),
            control_hz=None if environment is None else environment.fps,
            checkpoint=identity_of_config(config).weights_sha256,
        )
        self.config = PolicyConfig()
        self._instruction = ""

    def reset(self, scene: Scene) -> None:
        self._policy.begin()
        self._instruction = scene.instruction

    def act(self, observation: Observation) -> ActionChunk:
        """Return a chunk of one action.

        Raises:
            ValueError: the observation is not what the checkpoint reads.
        """
        state = np.concatenate([observation.state[name] for name in self._state]) if self._state else None
        instruction = observation.instruction or self._instruction
        return ActionChunk([Action(self._policy.act(observation.images, state, instruction))])


def _names_of(cameras: str) -> dict[str, str]:
    """Return {camera of the policy: the embodiment's name}."""
    pairs = [pair.split(":") for pair in cameras.split(",") if pair]
    if any(len(pair) != 2 for pair in pairs):
        raise ValueError(f"cameras={cameras}: name them as image:front,image2:wrist")
    return dict(pairs)
