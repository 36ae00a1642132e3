"""Datasets whose actions follow their state."""

from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata

NAMES = ["x", "y", "z", "grip"]


def make_dataset(
    root: Path, reach: float, *, delta: bool = False, names: Any = NAMES
) -> LeRobotDatasetMetadata:
    """Write two episodes of 30 frames; an action is the state and up to `reach` more, or its change."""
    features = {
        key: {"dtype": "float32", "shape": (4,), "names": names} for key in ("observation.state", "action")
    }
    dataset = LeRobotDataset.create("test/relative", fps=10, features=features, root=root, use_videos=False)
    generator = np.random.default_rng(0)
    for _ in range(2):
        states = np.cumsum(generator.uniform(-1, 1, size=(30, 4)), axis=0)
        offsets = generator.uniform(-reach, reach, size=(30, 4))
        actions = np.diff(states, axis=0, append=states[-1:]) if delta else states + offsets
        for state, action in zip(states, actions, strict=True):
            frame = {"observation.state": state.astype(np.float32), "action": action.astype(np.float32)}
            dataset.add_frame({**frame, "task": "push"})
        dataset.save_episode()
    dataset.finalize()
    return LeRobotDatasetMetadata("test/relative", root=root)
