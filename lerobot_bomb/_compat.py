"""The only place that reaches into names of LeRobot and `datasets` that are not their public interface."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from datasets import config
from lerobot.datasets import LeRobotDataset, compute_stats

STATISTICS_SIZE = 128  # pixels


def sample_pixels(image: np.ndarray) -> np.ndarray:
    """(C, H, W) -> every n-th pixel of every n-th row, so that about STATISTICS_SIZE of each are left."""
    stride = max(1, max(image.shape[1:]) // STATISTICS_SIZE)
    return image[:, ::stride, ::stride]


@contextmanager
def sampled_image_statistics() -> Iterator[None]:
    """Let LeRobot's video encoder take image statistics from a sample of the pixels.

    It samples so itself from 300 pixels on; all pixels of a 256x256 frame cost 5 ms of one core.
    """
    usual = compute_stats.auto_downsample_height_width
    compute_stats.auto_downsample_height_width = sample_pixels
    try:
        yield
    finally:
        compute_stats.auto_downsample_height_width = usual


def abandon(dataset: LeRobotDataset) -> None:
    """End the threads of a dataset that is being written, and let none of it be written later.

    When it is garbage collected, LeRobot would write its table of episodes, and make the folder for it anew.
    """
    dataset.clear_episode_buffer()
    dataset.meta._finalized = True


@contextmanager
def datasets_cache(folder: Path) -> Iterator[None]:
    """Let `datasets` cache what it reads here only; in the user's cache a copy of it would stay."""
    usual = config.HF_DATASETS_CACHE
    config.HF_DATASETS_CACHE = folder
    try:
        yield
    finally:
        config.HF_DATASETS_CACHE = usual
        shutil.rmtree(folder, ignore_errors=True)
