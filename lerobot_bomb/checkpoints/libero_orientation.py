"""Check that a policy was trained on LIBERO's images in the orientation that its environment shows."""

import logging
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata

from lerobot_bomb.checkpoints.acting import acting_config, name_of
from lerobot_bomb.checkpoints.environment import dataset_of_training
from lerobot_bomb.data.dataset_files import INFO_FILE
from lerobot_bomb.libero.orientation import SAME, orientation

logger = logging.getLogger(__name__)

MAX_EPISODES, MAX_IMAGES = 3, 12  # of a dataset, that are read


class OrientationCheck:
    """Warns once per evaluation if the training's images were turned; their dataset must be on this machine.

    Args:
        key: feature of the dataset that holds the images.
    """

    def __init__(self, key: str) -> None:
        self._key = key
        self._is_done = False

    def compare(self, shown: np.ndarray, task: str) -> None:
        """Compare images of the environment, (N, H, W, 3) uint8, with those of a task in the training."""
        config = None if self._is_done else acting_config()
        if config is None:
            return
        root = dataset_of_training(config)
        images = None if root is None else images_of_task(root, self._key, task)
        if images is None or images.shape[1:] != shown.shape[1:]:
            return
        self._is_done = True
        found = orientation(images, shown)
        if found != SAME:
            logger.warning(
                "%s was trained on images of %s that are %s, beside those of this environment: it cannot "
                "succeed here. Convert its demonstrations in the other orientation (lerobot-bomb convert "
                "libero-hdf5 does) and train it on them",
                name_of(config),
                root,
                found,
            )


@cache  # each condition of an evaluation asks for the same
def images_of_task(root: Path, key: str, task: str) -> np.ndarray | None:
    """(N, H, W, 3) uint8 images of one task; None if no dataset is on this machine: nothing is downloaded."""
    if not (root / INFO_FILE).is_file():
        return None
    meta = LeRobotDatasetMetadata(root.name, root=root)
    if key not in meta.camera_keys:
        return None
    episodes: Any = meta.episodes
    numbers = [
        number
        for number, tasks in enumerate(episodes["tasks"])
        if task in tasks and all((root / file).is_file() for file in _files_of(meta, number))
    ][:MAX_EPISODES]
    if not numbers:
        return None
    dataset: Any = LeRobotDataset(meta.repo_id, root=root, episodes=numbers)
    moments = np.unique(np.linspace(0, len(dataset) - 1, MAX_IMAGES).astype(int))
    images = np.stack([dataset[moment][key].numpy() for moment in moments.tolist()])
    return np.round(255 * images.transpose(0, 2, 3, 1)).astype(np.uint8)


def _files_of(meta: LeRobotDatasetMetadata, number: int) -> list[Path]:
    """Return the files of an episode's frames, below the dataset's folder."""
    return [
        meta.get_data_file_path(number),
        *(meta.get_video_file_path(number, key) for key in meta.video_keys),
    ]
