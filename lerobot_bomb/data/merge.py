"""Several datasets as one."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lerobot.utils.constants import DEFAULT_FEATURES

from lerobot_bomb.data.blocks import DatasetLayout, merge_blocks
from lerobot_bomb.data.columns import read_meta
from lerobot_bomb.data.unfinished import unfinished_folder


def merge_datasets(folders: Sequence[Path], repo_id: str, root: Path) -> tuple[int, int]:
    """Join datasets, in their order; return the numbers of episodes and frames.

    LeRobot's own merge rewrites what is there with each file that it adds. The new dataset appears whole.

    Raises:
        ValueError: a folder holds no dataset, or two differ in columns, rate or robot; or root exists.
        OSError: the disk is full.
    """
    if root.exists():
        raise ValueError(f"--root={root} exists; give a new folder")
    metas = [read_meta(repo_id, folder) for folder in folders]
    first = metas[0]
    for folder, meta in zip(folders, metas, strict=True):
        names = [name for name in ("fps", "robot_type") if getattr(meta, name) != getattr(first, name)]
        both = first.features | meta.features
        names += [key for key in both if meta.features.get(key) != first.features.get(key)]
        if names:
            raise ValueError(
                f"{folder} and {folders[0]} differ in {', '.join(names)}, so they cannot be one dataset"
            )
    features = {key: value for key, value in first.features.items() if key not in DEFAULT_FEATURES}
    arrays = [key for key, value in features.items() if len(value["shape"]) == 2]
    robot: Any = first.robot_type  # None in datasets of others
    layout = DatasetLayout(repo_id, first.fps, robot, features, bool(first.video_keys), tuple(arrays))
    unfinished = unfinished_folder(root, "merging")
    shutil.rmtree(unfinished, ignore_errors=True)
    merge_blocks(layout, list(folders), unfinished)
    unfinished.rename(root)
    return sum(meta.total_episodes for meta in metas), sum(meta.total_frames for meta in metas)
