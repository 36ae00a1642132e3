"""An episode as it ran: the gripper's path, and a filmstrip."""

from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np

from lerobot_bomb.bomb.expert import current_goal
from lerobot_bomb.bomb.observation import ENVIRONMENT_STATE
from lerobot_bomb.bomb.privileged_state import PrivilegedState
from lerobot_bomb.envs.rollout import Moment
from lerobot_bomb.viewing.episode import ViewedRun
from lerobot_bomb.viewing.film import Watch, as_jpeg, run_filmed

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


def run_for_explanation(run: ViewedRun, with_film: bool, watch: Watch | None = None) -> EpisodeRun:
    """Run an episode and keep its paths; ``watch`` as in `run_filmed`."""
    states: list[PrivilegedState] = []

    def keep(env: gymnasium.Env, moment: Moment) -> None:
        if ENVIRONMENT_STATE in moment.observation:
            states.append(moment.state)
        if watch is not None:
            watch(env, moment)

    result, film = run_filmed(run, keep, with_film)
    return EpisodeRun(
        result,
        np.array([each.gripper_xyz for each in states]).reshape(-1, 3),
        np.array([each.stone_xyz[current_goal(each).stone] for each in states]).reshape(-1, 3),
        None if film is None else as_jpeg(film),
    )
