"""Predictors of action chunks that look at no image, which a policy must beat.

Shapes: `N` recorded frames, `R` of them that are predicted from, `T` actions of a chunk, `D` action dims.
"""

from dataclasses import dataclass

import numpy as np
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION, OBS_STATE

from lerobot_bomb.data.columns import DONE, EPISODE_INDEX, episode_bounds, read_columns, run_index

HOLD, REPEAT, EXTRAPOLATE, MEAN = "hold", "repeat", "extrapolate", "mean"


@dataclass(frozen=True)
class Demonstrations:
    """Recorded actions of whole episodes, in order; mean and range are those of `is_train`.

    Nothing precedes or follows a static scene.
    """

    actions: np.ndarray  # (N, D)
    states: np.ndarray | None  # (N, D), only where a state has as many dimensions as an action
    episode_index: np.ndarray  # (N,)
    run_index: np.ndarray  # (N,) as `lerobot_bomb.data.columns.run_index`
    is_train: np.ndarray  # (N,) bool

    @classmethod
    def read(
        cls, meta: LeRobotDatasetMetadata, episodes: list[int], train_episodes: list[int]
    ) -> "Demonstrations":
        """Read these episodes; mean and range are of all of them if none is a training episode."""
        shapes = [tuple(meta.features.get(key, {}).get("shape", ())) for key in (ACTION, OBS_STATE)]
        keys = [ACTION, OBS_STATE] if shapes[0] == shapes[1] else [ACTION]
        columns = read_columns(meta, [*keys, DONE] if DONE in meta.features else keys, episodes)
        return cls(
            actions=columns[ACTION].astype(np.float64),
            states=columns[OBS_STATE].astype(np.float64) if OBS_STATE in columns else None,
            episode_index=columns[EPISODE_INDEX],
            run_index=run_index(columns),
            is_train=np.isin(columns[EPISODE_INDEX], train_episodes or episodes),
        )

    def recorded(self, rows_R: np.ndarray, chunk_size: int) -> tuple[np.ndarray, np.ndarray]:
        """Return recorded chunks (R, T, D), and which actions lie beyond their run's end (R, T) bool.

        Beyond it the last action is repeated, as LeRobot does.
        """
        _, ends_N = episode_bounds(self.run_index)
        rows_RT = rows_R[:, None] + np.arange(chunk_size)
        last_R1 = ends_N[rows_R, None] - 1
        return self.actions[np.minimum(rows_RT, last_R1)], rows_RT > last_R1

    def trivial(self, rows_R: np.ndarray, chunk_size: int) -> dict[str, np.ndarray]:
        """{name: predicted chunks (R, T, D)}.

        A run's first frame has no action before it; the state, or else the mean, stands for it.
        """
        train_ND = self.actions[self.is_train]
        mean_RD = np.repeat(train_ND.mean(axis=0, keepdims=True), len(rows_R), axis=0)
        state_RD = None if self.states is None else self.states[rows_R]
        starts_N, _ = episode_bounds(self.run_index)
        age_R1 = (rows_R - starts_N[rows_R])[:, None]  # frames since the run's first
        last_RD = np.where(age_R1 >= 1, self.actions[rows_R - 1], mean_RD if state_RD is None else state_RD)
        before_RD = np.where(age_R1 >= 2, self.actions[rows_R - 2], last_RD)
        ahead_T1 = np.arange(1, chunk_size + 1)[:, None]
        line_RTD = last_RD[:, None] + ahead_T1 * (last_RD - before_RD)[:, None]
        held = {} if state_RD is None else {HOLD: _repeated(state_RD, chunk_size)}
        return {
            **held,
            REPEAT: _repeated(last_RD, chunk_size),
            EXTRAPOLATE: line_RTD.clip(train_ND.min(axis=0), train_ND.max(axis=0)),
            MEAN: _repeated(mean_RD, chunk_size),
        }


def _repeated(actions_RD: np.ndarray, chunk_size: int) -> np.ndarray:
    return np.repeat(actions_RD[:, None], chunk_size, axis=1)
