"""Film of an episode: the gripper's path, and pictures of its start, its first grasp and its end."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np

from lerobot_bomb.bomb.camera import PinholeCamera
from lerobot_bomb.bomb.expert import current_goal
from lerobot_bomb.bomb.observation import ENVIRONMENT_STATE, PIXELS
from lerobot_bomb.envs.rollout import Moment
from lerobot_bomb.explain.phases import REACH, phases_of

CAMERA = "workspace"  # the one that sees the board as a whole


@dataclass(frozen=True)
class Frame:
    """Picture of one moment."""

    step: int
    image: np.ndarray  # (H, W, 3) uint8
    camera: PinholeCamera | None  # None: not known
    target_xyz: np.ndarray | None  # (3,) metres


@dataclass(frozen=True)
class EpisodeRun:
    """An episode as it ran."""

    result: Any  # its record
    gripper_xyz: np.ndarray  # (T + 1, 3) metres, before each step and at the end; (0, 3): not known
    stone_xyz: np.ndarray  # (T + 1, 3) metres, of the stone that is meant
    frames: dict[str, Frame]  # start, grasp, end

    @property
    def paths(self) -> dict[str, list[list[float]]]:
        """Paths from above in metres, for JSON."""
        return {
            "gripper_xy_m": self.gripper_xyz[:, :2].round(5).tolist(),
            "stone_xy_m": self.stone_xyz[:, :2].round(5).tolist(),
        }


class Film:
    """Collector of an episode's moments, one after the other, while the environment is in each."""

    def __init__(self) -> None:
        self._moments: list[Moment] = []
        self._frames: list[Frame] = []

    def add(self, moment: Moment, env: gymnasium.Env) -> None:
        """Add a moment."""
        pixels = moment.observation.get(PIXELS)
        image = pixels.get(CAMERA) if isinstance(pixels, dict) else pixels
        is_bomb = ENVIRONMENT_STATE in moment.observation
        camera = env.get_wrapper_attr("cameras")()[CAMERA] if is_bomb else None
        target_xyz = current_goal(moment.state).xyz if is_bomb else None
        self._moments.append(moment)
        if image is not None:
            self._frames.append(Frame(moment.step, image, camera, target_xyz))

    def end(self, env: gymnasium.Env) -> EpisodeRun:
        """Return the episode, which has ended."""
        states = [each.state for each in self._moments if ENVIRONMENT_STATE in each.observation]
        return EpisodeRun(
            env.get_wrapper_attr("episode_result")(),
            np.array([each.gripper_xyz for each in states]).reshape(-1, 3),
            np.array([each.stone_xyz[current_goal(each).stone] for each in states]).reshape(-1, 3),
            dict(self._chosen()),
        )

    def _chosen(self) -> Iterator[tuple[str, Frame]]:
        if not self._frames:
            return
        yield "start", self._frames[0]
        states = [each.state for each in self._moments if ENVIRONMENT_STATE in each.observation]
        grasps = [i for i, (phase, _) in enumerate(phases_of(states)) if phase != REACH]
        if grasps:
            yield "grasp", self._frames[grasps[0]]
        yield "end", self._frames[-1]
