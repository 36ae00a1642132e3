"""Whether a policy was trained on images of LIBERO in the orientation that its environment shows."""

import logging
from typing import Any

import numpy as np
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata

from lerobot_bomb.checkpoints.environment import asked_policy, dataset_of_training
from lerobot_bomb.data.dataset_files import INFO_FILE
from lerobot_bomb.libero.orientation import SAME, orientation

logger = logging.getLogger(__name__)

MAX_EPISODES, MAX_IMAGES = 3, 12  # of a dataset, that are read


class OrientationCheck:
    """Says once in an evaluation that the policy's images were turned, where their dataset is still here.

    Args:
        key: feature of the dataset that holds the images.
    """

    def __init__(self, key: str) -> None:
        self._key = key
        self._is_done = False

    def compare(self, shown: np.ndarray, task: str) -> None:
        """Images of the environment, (N, H, W, 3) uint8, in episodes of a task of the suite."""
        asked = None if self._is_done else asked_policy()
        if asked is None:
            return
        policy, who, _ = asked
        root = dataset_of_training(policy)
        if root is None or not (root / INFO_FILE).is_file():
            return
        images = _images_of_task(LeRobotDatasetMetadata(root.name, root=root), self._key, task)
        if images is None or images.shape[1:] != shown.shape[1:]:
            return
        self._is_done = True
        found = orientation(images, shown)
        if found != SAME:
            logger.warning(
                "%s was trained on images of %s that are %s, beside those of this environment: it cannot "
                "succeed here. Convert its demonstrations in the other orientation (lerobot-bomb convert "
                "libero-hdf5 does) and train it on them",
                who,
                root,
                found,
            )


def _images_of_task(meta: LeRobotDatasetMetadata, key: str, task: str) -> np.ndarray | None:
    """(N, H, W, 3) uint8 of episodes of one task; None: the dataset has none."""
    episodes: Any = meta.episodes
    numbers = [number for number, tasks in enumerate(episodes["tasks"]) if task in tasks][:MAX_EPISODES]
    if key not in meta.camera_keys or not numbers:
        return None
    dataset: Any = LeRobotDataset(meta.repo_id, root=meta.root, episodes=numbers)
    moments = np.unique(np.linspace(0, len(dataset) - 1, MAX_IMAGES).astype(int))
    images = np.stack([dataset[moment][key].numpy() for moment in moments.tolist()])
    return np.round(255 * images.transpose(0, 2, 3, 1)).astype(np.uint8)
