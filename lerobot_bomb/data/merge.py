"""Several datasets as one."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lerobot.utils.constants import ACTION, DEFAULT_FEATURES, OBS_STATE

from lerobot_bomb.data.blocks import DatasetLayout, merge_blocks
from lerobot_bomb.data.columns import read_meta
from lerobot_bomb.data.dataset_files import episode_tables
from lerobot_bomb.data.facts import SPEC_COLUMN
from lerobot_bomb.data.unfinished import unfinished_folder

# columns of LeRobot's table of episodes that tell one from all others: scenes and demonstrations, or an
# expert's and a policy's episodes, may have one spec
IDENTITY = (SPEC_COLUMN, "length", f"stats/{OBS_STATE}/mean", f"stats/{ACTION}/mean")


def merge_datasets(folders: Sequence[Path], repo_id: str, root: Path) -> tuple[int, int]:
    """Join datasets, in their order; return the numbers of episodes and frames.

    LeRobot's own merge rewrites what is there with each file that it adds. The new dataset appears whole.

    Raises:
        ValueError: a folder holds no dataset, or two differ in columns, rate or robot, or hold the same
            episode; or root exists.
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
    _refuse_same_episodes(folders)
    features = {key: value for key, value in first.features.items() if key not in DEFAULT_FEATURES}
    arrays = [key for key, value in features.items() if len(value["shape"]) == 2]
    robot: Any = first.robot_type  # None in datasets of others
    layout = DatasetLayout(repo_id, first.fps, robot, features, bool(first.video_keys), tuple(arrays))
    unfinished = unfinished_folder(root, "merging")
    shutil.rmtree(unfinished, ignore_errors=True)
    merge_blocks(layout, list(folders), unfinished)
    unfinished.rename(root)
    return sum(meta.total_episodes for meta in metas), sum(meta.total_frames for meta in metas)


def _refuse_same_episodes(folders: Sequence[Path]) -> None:
    """Raise a ValueError that names two folders which are one, or which hold the same episode of BOMB."""
    owners: dict[Any, Path] = {}
    for folder in folders:
        found: dict[Any, str] = {folder.resolve(): "are one dataset"}
        for number, episode in enumerate(_identities(folder)):
            found.setdefault(episode, f"both hold episode {number} of {folder}")
        for each, what in found.items():
            if each in owners:
                raise ValueError(f"{owners[each]} and {folder} {what}; give each episode once")
        owners |= dict.fromkeys(found, folder)


def _identities(folder: Path) -> list[str]:
    """Return a text for each episode that is equal for the same episode; [] for datasets of others."""
    tables = episode_tables(folder)
    if any(name not in table.column_names for table in tables for name in IDENTITY):
        return []
    return [str(row) for table in tables for row in table.select(IDENTITY).to_pylist()]
