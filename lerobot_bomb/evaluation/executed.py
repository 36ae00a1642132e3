"""Executed actions, from a dataset or from the file that ``lerobot-bomb results actions`` writes.

Shapes: `T` actions of an episode, `D` action dims.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION

from lerobot_bomb.data.columns import EPISODE_INDEX, read_columns, read_meta, require_motion
from lerobot_bomb.files import append_line


@dataclass(frozen=True)
class ActionLog:
    """Actions of whole episodes, in order of time."""

    name: str  # of the dataset or file
    fps: float  # actions a second
    episodes: dict[str, np.ndarray]  # {name of an episode: (T, D)}
    is_seeded: bool  # the same episode of another file has the same start

    def __post_init__(self) -> None:
        if not self.episodes:
            raise ValueError(f"{self.name}: no episode")
        if len({actions_TD.shape[1] for actions_TD in self.episodes.values()}) > 1:
            raise ValueError(f"{self.name}: episodes differ in the number of action dims")
        if not self.fps > 0:
            raise ValueError(f"{self.name}: fps={self.fps} must be positive")
        for episode, actions_TD in self.episodes.items():
            if not np.isfinite(actions_TD).all():
                raise ValueError(f"{self.name}: episode {episode} has actions that are not finite")

    @property
    def num_dims(self) -> int:
        return next(iter(self.episodes.values())).shape[1]


def read_executed(path: Path) -> ActionLog:
    """Read a file of ``lerobot-bomb results actions`` or a LeRobotDataset's folder.

    Raises:
        ValueError: it is neither, or holds no whole episodes.
    """
    if path.is_dir():
        if not (path / "meta" / "info.json").is_file():
            raise ValueError(f"{path} holds no meta/info.json, so it is no LeRobotDataset")
        return executed_in_dataset(read_meta(path.name, path), str(path))
    if not path.is_file():
        raise ValueError(
            f"{path}: no such file or folder; `lerobot-bomb results actions {path} ...` writes such a file"
        )
    return read_action_log(path)


def executed_in_dataset(meta: LeRobotDatasetMetadata, name: str) -> ActionLog:
    """Read all recorded actions, each episode under its number."""
    if ACTION not in meta.features:
        raise ValueError(f"dataset {name} has no {ACTION!r}; it has {sorted(meta.features)}")
    require_motion(meta, "how smoothly they move is not defined")
    columns = read_columns(meta, (ACTION,))
    numbers, starts = np.unique(columns[EPISODE_INDEX], return_index=True)
    of_episodes = np.split(columns[ACTION], starts[1:])
    return ActionLog(name, meta.fps, dict(zip(map(str, numbers), of_episodes, strict=True)), False)


def append_episode(
    path: Path, group: str, task_id: int, seed: int, fps: float, actions_TD: np.ndarray
) -> None:
    """Append a line with an episode's group, task, seed and rate, and its actions."""
    row = {"group": group, "task_id": task_id, "seed": seed, "fps": fps, "actions": actions_TD.tolist()}
    append_line(path, json.dumps(row))


def start_of(episode: str) -> str:
    """Return the seed of an episode that `read_action_log` named, else its name."""
    return episode.rpartition(", ")[2]


def read_action_log(path: Path) -> ActionLog:
    """Read the episodes that ``append_episode`` wrote.

    Raises:
        ValueError: a line holds no episode, repeats one, or has another rate.
    """
    episodes: dict[str, np.ndarray] = {}
    rates = set()
    for number, line in enumerate(path.read_bytes().splitlines(), start=1):
        try:
            row = json.loads(line)
            episode = f"{row['group']}, task {row['task_id']}, seed {row['seed']}"
            actions_TD = np.array(row["actions"], dtype=np.float64)
            rates.add(float(row["fps"]))
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"{path}:{number}: not the actions of an episode, as `lerobot-bomb results actions` writes "
                "them"
            ) from error
        if actions_TD.ndim != 2:
            raise ValueError(f"{path}:{number}: actions have the shape {actions_TD.shape}, not (T, D)")
        if episode in episodes:
            raise ValueError(f"{path}:{number}: {episode} was there already; a file holds one evaluation")
        episodes[episode] = actions_TD
    if len(rates) > 1:
        raise ValueError(f"{path}: episodes of different rates, {sorted(rates)} actions a second")
    return ActionLog(str(path), rates.pop() if rates else 0.0, episodes, True)
