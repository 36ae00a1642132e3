"""Datasets of a few frames with any cameras and dimensions, written by LeRobot."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets import LeRobotDataset

STATE, ACTION = "observation.state", "action"


def write_dataset(
    root: Path,
    numbers: Callable[[int], tuple[Any, Any]],
    *,
    cameras: tuple[str, ...] = ("wrist",),
    size: int = 32,
    num_frames: int = 6,
) -> LeRobotDataset:
    """Write two episodes; ``numbers``: frame -> state and action, whose types and sizes are the columns'."""
    image = {"dtype": "image", "shape": (size, size, 3), "names": ["height", "width", "channels"]}
    features: dict[str, Any] = {f"observation.images.{camera}": image for camera in cameras}
    for key, values in zip((STATE, ACTION), map(np.asarray, numbers(0)), strict=True):
        names = [f"joint_{dim}" for dim in range(len(values))]
        features[key] = {"dtype": values.dtype.name, "shape": values.shape, "names": names}
    repo_id = f"test/{root.name}"
    made = LeRobotDataset.create(repo_id, fps=10, features=features, root=root, use_videos=False)
    for _ in range(2):
        for frame in range(num_frames):
            pixels = np.full((size, size, 3), 20 * frame, dtype=np.uint8)
            state, action = numbers(frame)
            images = {f"observation.images.{camera}": pixels for camera in cameras}
            made.add_frame({**images, STATE: state, ACTION: action, "task": "go"})
        made.save_episode()
    made.finalize()
    return LeRobotDataset(repo_id, root=root)
