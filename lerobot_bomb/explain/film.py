"""An episode as it ran: the gripper's path, and a filmstrip."""

from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np

from lerobot_bomb.bomb.expert import current_goal
from lerobot_bomb.bomb.observation import ENVIRONMENT_STATE
from lerobot_bomb.bomb.privileged_state import PrivilegedState
from lerobot_bomb.environments import env_type
from lerobot_bomb.envs.rollout import Moment
from lerobot_bomb.viewing.episode import Viewed
from lerobot_bomb.viewing.film import Film, as_jpeg, draw_film

CAMERA = "workspace"  # the one that sees the board as a whole


@dataclass(frozen=True)
class EpisodeRun:
    """An episode as it ran."""

    result: Any  # its record
    gripper_xyz: np.ndarray  # (T + 1, 3) metres, before each step and at the end; (0, 3): not known
    stone_xyz: np.ndarray  # (T + 1, 3) metres, of the stone that is meant
    film: bytes | None  # JPEG of its filmstrip; None: not drawn

    @property
    def paths(self) -> dict[str, list[list[float]]]:
        """Paths from above in metres, for JSON."""
        return {
            "gripper_xy_m": self.gripper_xyz[:, :2].round(5).tolist(),
            "stone_xy_m": self.stone_xyz[:, :2].round(5).tolist(),
        }


class EpisodeCollector:
    """Collector of an episode's moments, one after the other, while the environment is in each."""

    def __init__(self, viewed: Viewed, env: gymnasium.Env, with_film: bool) -> None:
        self._viewed, self._env = viewed, env
        self._states: list[PrivilegedState] = []
        self._film = Film(env_type(viewed.env_type).view, env) if with_film else None

    def add(self, moment: Moment) -> None:
        """Add a moment."""
        if ENVIRONMENT_STATE in moment.observation:
            self._states.append(moment.state)
        if self._film is not None:
            self._film.add(moment)

    def end(self) -> EpisodeRun:
        """Return the episode, which has ended."""
        result = self._env.get_wrapper_attr("episode_result")()
        film = None if self._film is None else draw_film(self._film, self._viewed, result)
        return EpisodeRun(
            result,
            np.array([each.gripper_xyz for each in self._states]).reshape(-1, 3),
            np.array([each.stone_xyz[current_goal(each).stone] for each in self._states]).reshape(-1, 3),
            None if film is None else as_jpeg(film),
        )
