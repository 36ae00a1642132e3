"""Changes to LeRobot's writer of datasets, while recorder or converters write."""

import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from datasets import Dataset, config
from datasets.table import embed_table_storage
from lerobot.datasets import LeRobotDataset, aggregate, compute_stats, dataset_writer, io_utils
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.io_utils import to_parquet_with_hf_images
from lerobot.utils.constants import DEFAULT_FEATURES


@contextmanager
def statistics_by(kind: type[compute_stats.RunningQuantileStats]) -> Iterator[None]:
    """Let LeRobot compute the statistics of episodes by another class."""
    usual = compute_stats.RunningQuantileStats
    compute_stats.RunningQuantileStats = kind
    try:
        yield
    finally:
        compute_stats.RunningQuantileStats = usual


@contextmanager
def without_statistics(keys: Collection[str]) -> Iterator[None]:
    """Let LeRobot write no statistics of these features, and so normalise none of them.

    It would take them for each pixel: gigabytes of histograms for one depth image.
    """
    usual = dataset_writer.compute_episode_stats

    def compute(data: dict[str, Any], features: dict[str, dict]) -> dict[str, dict]:
        return usual({key: values for key, values in data.items() if key not in keys}, features)

    dataset_writer.compute_episode_stats = compute
    try:
        yield
    finally:
        dataset_writer.compute_episode_stats = usual


def embed_in_batches(dataset: Dataset) -> Dataset:
    """Put the bytes of image files into a dataset's table, in batches."""
    shown_as = dataset.format
    return dataset.with_format("arrow").map(embed_table_storage, batched=True).with_format(**shown_as)


@contextmanager
def batched_embedding() -> Iterator[None]:
    """Let LeRobot put images into tables a thousand rows at a time; row by row is a third of recording."""
    usual = io_utils.embed_images
    dataset_writer.embed_images = io_utils.embed_images = embed_in_batches
    try:
        yield
    finally:
        dataset_writer.embed_images = io_utils.embed_images = usual


@contextmanager
def mergeable_arrays(features: dict[str, dict]) -> Iterator[None]:
    """Let LeRobot merge tables that hold arrays of two dimensions.

    LeRobot names the types of tables that hold images; for others pyarrow must guess them.
    """
    usual = aggregate.to_parquet_one_row_group_per_episode
    types = get_hf_features_from_features(features | DEFAULT_FEATURES)
    aggregate.to_parquet_one_row_group_per_episode = partial(to_parquet_with_hf_images, features=types)
    try:
        yield
    finally:
        aggregate.to_parquet_one_row_group_per_episode = usual


def abandon(dataset: LeRobotDataset) -> None:
    """End the threads of an unfinished dataset, and let nothing of it be written later.

    At garbage collection, LeRobot would write its table of episodes, and make the folder for it anew.
    """
    dataset.clear_episode_buffer()
    dataset.meta._finalized = True


@contextmanager
def datasets_cache(folder: Path) -> Iterator[None]:
    """Let `datasets` cache in this folder only; in the user's cache a copy would stay."""
    usual = config.HF_DATASETS_CACHE
    config.HF_DATASETS_CACHE = folder
    try:
        yield
    finally:
        config.HF_DATASETS_CACHE = usual
        shutil.rmtree(folder, ignore_errors=True)
