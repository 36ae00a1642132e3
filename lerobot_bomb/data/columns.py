"""Columns of a dataset, read without its images."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import DEFAULT_FEATURES, DONE, HF_LEROBOT_HOME

from lerobot_bomb.compat.hooks.datasets import explain_missing_datasets
from lerobot_bomb.compat.hooks.hub import check_tokens_before_use
from lerobot_bomb.data.dataset_files import INFO_FILE, check_metadata, flat_numbers, read_parquet
from lerobot_bomb.data.hub_token import check_token_characters
from lerobot_bomb.data.missing import describe_missing_dataset
from lerobot_bomb.data.resumable import check_repo_id

EPISODE_INDEX = "episode_index"


def read_meta(repo_id: str, root: Path | None) -> LeRobotDatasetMetadata:
    """Read a dataset's metadata; a given folder must exist, LeRobot's own may be filled from the Hub."""
    if root is None:  # with a folder, it is but a label
        check_repo_id(repo_id, "--dataset.repo_id")
        check_tokens_before_use(check_token_characters)
        explain_missing_datasets(describe_missing_dataset)
    if root is not None and not (root / INFO_FILE).is_file():
        raise ValueError(f"--dataset.root={root} holds no {INFO_FILE}, so it is no LeRobotDataset")
    check_metadata(root or HF_LEROBOT_HOME / repo_id)
    return LeRobotDatasetMetadata(repo_id, root=root)


def present_episodes(meta: LeRobotDatasetMetadata) -> list[int]:
    """Return the episodes whose data files are here: LeRobot downloads those of --dataset.episodes only."""
    present = [i for i in range(meta.total_episodes) if (meta.root / meta.get_data_file_path(i)).is_file()]
    if not present:
        raise ValueError(
            f"this policy is fitted to all frames before training, but {meta.root} holds no data file of "
            f"{meta.repo_id}; a dataset that is streamed (--dataset.streaming=true) must be downloaded first"
        )
    return present


def check_chunk_length(chunk_size: int, meta: LeRobotDatasetMetadata) -> None:
    """Raise a ValueError unless an episode of a dataset is at least as long as a chunk."""
    lengths = [] if meta.episodes is None else meta.episodes["length"]
    longest = max(lengths, default=chunk_size)
    if chunk_size > longest:
        raise ValueError(
            f"--policy.chunk_size={chunk_size}: the longest episode of {meta.repo_id} has {longest} frames; "
            f"give at most {longest}"
        )


def require_motion(meta: LeRobotDatasetMetadata, use: str) -> None:
    """Raise a ValueError that names the use if a dataset holds static scenes.

    Frames of `lerobot-bomb record --static` do not follow each other; `next.done` is true before the end.
    """
    if DONE not in meta.features:
        return
    columns = read_columns(meta, (DONE,), present_episodes(meta))
    episode_N = columns[EPISODE_INDEX]
    is_scene_N = (np.diff(run_index(columns)) > 0) & (episode_N[1:] == episode_N[:-1])
    if is_scene_N.any():
        raise ValueError(
            f"episode {int(episode_N[is_scene_N.argmax()])} of {meta.repo_id} holds static scenes, which do "
            f"not follow each other: {use}; take the demonstrations alone, before they are merged"
        )


def read_columns(
    meta: LeRobotDatasetMetadata, keys: Iterable[str], episodes: Sequence[int] | None = None
) -> dict[str, np.ndarray]:
    """{key: (N, ...)} of N frames in the dataset's order, `episode_index` (N,) always among them.

    Integer and boolean features are float64: what is computed from them has fractions.

    Reads the data files under ``meta.root``; ``LeRobotDataset`` downloads them if they are not there.

    Raises:
        ValueError: a key is no column of numbers, an episode does not exist, values are not finite, or a data
            file is truncated.
        FileNotFoundError: a data file is absent.
    """
    columns = list(dict.fromkeys([*keys, EPISODE_INDEX]))
    _check_columns(meta, columns)
    wanted = list(range(meta.total_episodes)) if episodes is None else sorted(set(episodes))
    absent = [episode for episode in wanted if not 0 <= episode < meta.total_episodes]
    if absent or not wanted:
        raise ValueError(
            f"dataset {meta.repo_id} has the episodes 0..{meta.total_episodes - 1}; "
            f"asked for {absent or 'none at all'}"
        )
    files = dict.fromkeys(meta.get_data_file_path(episode) for episode in wanted)
    rows = [(EPISODE_INDEX, "in", wanted)]
    read = list({*columns, "index"})
    tables = [read_parquet(meta.root / file, read, rows) for file in files]
    table = pa.concat_tables(tables).sort_by("index")
    shapes = {key: () if key in DEFAULT_FEATURES else meta.features[key]["shape"] for key in columns}
    arrays = {key: flat_numbers(table[key]).reshape(len(table), *shapes[key]) for key in columns}
    whole = [key for key in columns if key not in DEFAULT_FEATURES and arrays[key].dtype.kind != "f"]
    arrays |= {key: arrays[key].astype(np.float64) for key in whole}
    index_N = flat_numbers(table["index"])
    for key in columns:
        _require_finite(meta, key, arrays[key], arrays[EPISODE_INDEX], index_N)
    return arrays


def dim_names(feature: dict[str, Any]) -> list[str]:
    """Return the names of a feature's dimensions; their numbers if the dataset has no names."""
    names = feature.get("names") or []
    if isinstance(names, dict):
        names = [name for group in names.values() for name in (group if isinstance(group, list) else [group])]
    (num_dims,) = feature["shape"]
    return list(map(str, names if len(names) == num_dims else range(num_dims)))


def episode_bounds(episode_index_N: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sorted episodes (N,) of rows -> first row of each's episode and the row after its last, (N,) each."""
    return (
        np.searchsorted(episode_index_N, episode_index_N, side="left"),
        np.searchsorted(episode_index_N, episode_index_N, side="right"),
    )


def run_index(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return (N,) int64, which run of frames that follow each other a row belongs to.

    A run is an episode, or a static scene of one: `next.done`, where ``columns`` has it, is true in each.
    """
    episode_N = columns[EPISODE_INDEX]
    is_last_N = episode_N[1:] != episode_N[:-1]
    if DONE in columns:
        is_last_N |= columns[DONE].reshape(-1)[:-1] > 0
    return np.concatenate([[0], np.cumsum(is_last_N)]).astype(np.int64)


def _check_columns(meta: LeRobotDatasetMetadata, columns: list[str]) -> None:
    images_and_texts = ("image", "video", "string", "language")
    numeric = [key for key, feature in meta.features.items() if feature["dtype"] not in images_and_texts]
    unknown = [key for key in columns if key not in numeric]
    if unknown:
        raise ValueError(f"dataset {meta.repo_id} has no columns {unknown}; it has {sorted(numeric)}")


def _require_finite(
    meta: LeRobotDatasetMetadata,
    key: str,
    values_NX: np.ndarray,
    episode_index_N: np.ndarray,
    index_N: np.ndarray,
) -> None:
    bad_N = ~np.isfinite(values_NX.reshape(len(values_NX), -1)).all(axis=1)
    if bad_N.any():
        first = int(bad_N.argmax())
        episode, index = int(episode_index_N[first]), int(index_N[first])
        raise ValueError(
            f"dataset {meta.repo_id}: {key!r} is not finite (NaN or infinite) in {int(bad_N.sum())} of "
            f"{len(values_NX)} frames, the first of them frame {index} (its column 'index'), of "
            f"episode {episode}: {values_NX[first].tolist()}. Leave such episodes out: "
            f"lerobot-edit-dataset --operation.type=delete_episodes --operation.episode_indices=[{episode}]"
        )
