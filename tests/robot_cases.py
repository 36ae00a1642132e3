"""Robots without hardware for LeRobot's own commands: an arm like SO-101, its leader, and the one of BOMB.

Shapes: `K` actions of a chunk, `D` action dims.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from lerobot.policies import PreTrainedPolicy, get_policy_class
from lerobot.policies.utils import prepare_observation_for_inference
from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig
from torch import Tensor

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import ACTION_NAMES, CAMERAS, STATE_NAMES, RenderOptions
from lerobot_bomb.checkpoints.folder import Postprocessor, Preprocessor, load_processors, read_config
from lerobot_env_bomb.bomb.env import BombEnv

MOTORS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
KEYS = [f"{motor}.pos" for motor in MOTORS]
CAMERA, IMAGE_SHAPE = "front", (48, 64, 3)
PERIOD = 100  # readings after which the arm is back where it was


def position_at(reading: int) -> dict[str, float]:
    """Return every motor's degrees: each has its own range and speed, and moves whatever it is told."""
    away = (1 - np.cos(2 * np.pi * reading / PERIOD)) / 2
    return {key: float(15 * i + 8 * (i + 1) * away) for i, key in enumerate(KEYS)}


def command_at(reading: int) -> dict[str, float]:
    """Return the leader's command at a reading: the arm's position, and a little on."""
    return {
        key: value + float(np.sin(reading + i)) for i, (key, value) in enumerate(position_at(reading).items())
    }


@RobotConfig.register_subclass("scripted_arm")
@dataclass
class ScriptedArmConfig(RobotConfig):
    # number of the first reading
    start: int = 0
    # actions after which somebody presses Ctrl-C; 0: nobody does
    stop_after: int = 0


class Device:
    """Device with what LeRobot asks of every one."""

    is_connected = False
    is_calibrated = True

    def connect(self, calibrate: bool = True) -> None:
        self.is_connected = True

    def disconnect(self) -> None:
        self.is_connected = False

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...


class ScriptedArm(Device, Robot):  # pyright: ignore[reportIncompatibleMethodOverride]
    """Shows one image and moves on with every reading; keeps what it showed and what it was told."""

    config_class = ScriptedArmConfig
    name = "scripted_arm"
    cameras: ClassVar[dict[str, Any]] = {}  # LeRobot counts them to share out threads
    made: ClassVar[list["ScriptedArm"]] = []

    def __init__(self, config: ScriptedArmConfig):
        super().__init__(config)
        self.config = config
        self.shown: list[dict[str, Any]] = []
        self.told: list[dict[str, float]] = []
        self.num_shown_before: list[int] = []  # readings before each of the actions
        self.made.append(self)

    @cached_property
    def observation_features(self) -> dict[str, type | tuple]:
        return {**dict.fromkeys(KEYS, float), CAMERA: IMAGE_SHAPE}

    @cached_property
    def action_features(self) -> dict[str, type]:
        return dict.fromkeys(KEYS, float)

    def get_observation(self) -> dict[str, Any]:
        assert self.is_connected
        image = np.random.default_rng(0).integers(0, 256, IMAGE_SHAPE, dtype=np.uint8)
        self.shown.append({**position_at(self.config.start + len(self.shown)), CAMERA: image})
        return dict(self.shown[-1])

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        assert self.is_connected
        self.told.append(dict(action))
        self.num_shown_before.append(len(self.shown))
        if len(self.told) == self.config.stop_after:
            raise KeyboardInterrupt
        return action


@TeleoperatorConfig.register_subclass("scripted_leader")
@dataclass
class ScriptedLeaderConfig(TeleoperatorConfig):
    """Config of a leader that has nothing to choose."""


class ScriptedLeader(Device, Teleoperator):  # pyright: ignore[reportIncompatibleMethodOverride]
    """Leads an arm that starts at reading 0."""

    config_class = ScriptedLeaderConfig
    name = "scripted_leader"
    feedback_features: ClassVar[dict[str, type]] = {}

    def __init__(self, config: ScriptedLeaderConfig):
        super().__init__(config)
        self._num_read = 0

    @cached_property
    def action_features(self) -> dict[str, type]:
        return dict.fromkeys(KEYS, float)

    def get_action(self) -> dict[str, float]:
        self._num_read += 1
        return command_at(self._num_read - 1)

    def send_feedback(self, feedback: dict[str, Any]) -> None: ...


@RobotConfig.register_subclass("bomb_arm")
@dataclass
class BombArmConfig(RobotConfig):
    # actions after which somebody presses Ctrl-C
    stop_after: int = 0
    seed: int = 0
    image_size: int = 64


class BombArm(Device, Robot):  # pyright: ignore[reportIncompatibleMethodOverride]
    """BOMB's environment as LeRobot drives a robot."""

    config_class = BombArmConfig
    name = "bomb_arm"
    made: ClassVar[list["BombArm"]] = []

    def __init__(self, config: BombArmConfig):
        super().__init__(config)
        self.config = config
        self._env = BombEnv(EpisodeSpec(seed=config.seed), RenderOptions(image_size=config.image_size))
        self._seen, _ = self._env.reset(seed=config.seed)
        self.executed: list[np.ndarray] = []
        self.made.append(self)

    @cached_property
    def observation_features(self) -> dict[str, type | tuple]:
        shape = self.config.image_size, self.config.image_size, 3
        return {**dict.fromkeys(STATE_NAMES, float), **dict.fromkeys(CAMERAS, shape)}

    @cached_property
    def action_features(self) -> dict[str, type]:
        return dict.fromkeys(ACTION_NAMES["relative"], float)

    def get_observation(self) -> dict[str, Any]:
        state = zip(STATE_NAMES, self._seen["agent_pos"].tolist(), strict=True)
        return {**dict(state), **self._seen["pixels"]}

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        self.executed.append(np.array([action[name] for name in ACTION_NAMES["relative"]], dtype=np.float32))
        self._seen, *_ = self._env.step(self.executed[-1])
        if len(self.executed) == self.config.stop_after:
            raise KeyboardInterrupt
        return action


@dataclass
class Loaded:
    """A checkpoint as a user's own loop would run it."""

    policy: PreTrainedPolicy
    preprocessor: Preprocessor
    postprocessor: Postprocessor

    @classmethod
    def of(cls, path: Path) -> "Loaded":
        config = read_config(path, "cpu")
        return cls(get_policy_class(config.type).from_pretrained(path), *load_processors(config))

    def batch(self, seen: dict[str, Any], task: str) -> dict[str, Any]:
        """Return what the policy reads of a robot's observation."""
        numbers = [value for value in seen.values() if isinstance(value, float)]
        images = {
            f"observation.images.{name}": value for name, value in seen.items() if hasattr(value, "shape")
        }
        observation = {"observation.state": np.array(numbers, dtype=np.float32), **images}
        return self.preprocessor(prepare_observation_for_inference(observation, torch.device("cpu"), task))

    def physical(self, chunk_1KD: Tensor) -> Tensor:
        """(K, D) in the robot's units."""
        return torch.cat([self.postprocessor(action_1D) for action_1D in chunk_1KD.unbind(dim=1)])
