"""Blocks of a growing dataset: small finished LeRobotDatasets, merged into one at the end.

LeRobot's parquet files can be read only after `finalize`, so a dataset is lost if its
writer is killed. Blocks bound that loss to the episodes of one block, which are made again.
"""

import gc
import logging
import os
import shutil
import tempfile
import traceback
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import av
import pyarrow as pa
import pyarrow.parquet as pq
from av.logging import WARNING, set_libav_level
from datasets import disable_progress_bars, enable_progress_bars
from datasets.exceptions import DatasetGenerationError
from lerobot.datasets import LeRobotDataset, aggregate_datasets
from lerobot.datasets.utils import DEFAULT_EPISODES_PATH

from lerobot_bomb.compat.own.merging import merged_at_once
from lerobot_bomb.compat.own.recording import (
    abandon,
    batched_embedding,
    datasets_cache,
    mergeable_arrays,
    statistics_by,
    without_statistics,
)
from lerobot_bomb.data.running_statistics import ExactStats
from lerobot_bomb.data.statistics import write_image_statistics, write_statistics

ENCODER_THREADS = 1  # per camera, which keeps two cores busy; see benchmarks/record_speed.py
IMAGE_WRITER_THREADS = 4


@dataclass(frozen=True)
class DatasetLayout:
    """Settings that a block and the merged dataset have in common."""

    repo_id: str
    fps: int
    # LeRobot's merge refuses datasets of different robots
    robot_type: str
    features: dict[str, dict[str, Any]]
    use_videos: bool
    # features that no policy normalises: arrays of two dimensions, such as depth
    arrays: tuple[str, ...] = ()

    def create(self, root: Path) -> LeRobotDataset:
        """Create an empty dataset that is ready to be written."""
        return LeRobotDataset.create(
            self.repo_id,
            fps=self.fps,
            features=self.features,
            root=root,
            robot_type=self.robot_type,
            use_videos=self.use_videos,
            streaming_encoding=self.use_videos,
            # unlimited: LeRobot drops frames when this queue is full
            encoder_queue_maxsize=0,
            encoder_threads=ENCODER_THREADS,
            video_backend="pyav",  # for reading; LeRobot's probe of torchcodec prints a page where it fails
            image_writer_threads=0 if self.use_videos else IMAGE_WRITER_THREADS,
        )


@dataclass(frozen=True)
class RecordedEpisode:
    """Frames and columns of an episode that a block is made of."""

    frames: Iterable[dict[str, Any]]  # as LeRobot's add_frame takes them
    columns: dict[str, Any] = field(default_factory=dict)  # of its row in LeRobot's table of episodes


def write_block(layout: DatasetLayout, root: Path, episodes: Iterable[RecordedEpisode]) -> int:
    """Write episodes as a finished LeRobotDataset, or an empty folder; return the number of frames.

    Raises:
        RuntimeError: a video lacks frames, or a thread of LeRobot could not write an image or a video.
        OSError: the disk is full.
    """
    remaining = iter(episodes)
    first = next(remaining, None)
    if first is None:
        root.mkdir()
        return 0
    with (
        _quiet_libraries(),
        _logged_errors(),
        _temporary_files_beside(root),
        statistics_by(ExactStats),
        without_statistics(layout.arrays),
        batched_embedding(),
    ):
        dataset = layout.create(root)
        rows = _write_episodes(dataset, chain([first], remaining))
    _add_episode_columns(root, rows)
    num_frames = dataset.num_frames
    check_encoded_frames(root, dataset.meta.video_keys, num_frames)
    return num_frames


def merge_blocks(layout: DatasetLayout, blocks: list[Path], root: Path) -> None:
    """Merge finished blocks, in their order, into one dataset.

    Videos and tables are joined up to LeRobot's file sizes. Tables that hold images or depth stay one per
    block: they are large, and LeRobot holds a table in memory as Python objects. Statistics of numbers are
    those of all frames; statistics of images follow from those of all episodes.

    Raises:
        OSError: the disk is full.
    """
    repo_ids = [layout.repo_id] * len(blocks)
    cache = datasets_cache(root.with_name(f"{root.name}.cache"))
    arrays = mergeable_arrays(layout.features) if layout.arrays else nullcontext()
    embedding = batched_embedding()
    with _quiet_libraries(), _temporary_files_beside(root), cache, arrays, embedding, merged_at_once():
        try:
            aggregate_datasets(
                repo_ids,
                layout.repo_id,
                roots=blocks,
                aggr_root=root,
                concatenate_data=layout.use_videos and not layout.arrays,
            )
        except DatasetGenerationError as error:
            raise OSError(f"the blocks could not be read: {error.__cause__}") from error
    # LeRobot's are means over the blocks, and its keys in the order of a set, which differs from run to run
    write_image_statistics(root)
    write_statistics(root)


@contextmanager
def _quiet_libraries() -> Iterator[None]:
    """Show no bar of `datasets` per episode, and only warnings of the encoders, not a page per video."""
    os.environ.setdefault("SVT_LOG", "1")
    set_libav_level(WARNING)
    disable_progress_bars()
    try:
        yield
    finally:
        enable_progress_bars()


@contextmanager
def _temporary_files_beside(root: Path) -> Iterator[None]:
    """Let LeRobot join videos beside a dataset, not in the system's folder, where a kill would leave them."""
    usual = tempfile.tempdir
    folder = root.with_name(f"{root.name}.files")
    folder.mkdir()
    tempfile.tempdir = str(folder)
    try:
        yield
    except BaseException as error:
        # the error's frames may hold a video that was being joined; PyAV finishes it when it is
        # collected, and prints a traceback unless its file is still there
        traceback.clear_frames(error.__traceback__)
        gc.collect()
        raise
    finally:
        tempfile.tempdir = usual
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _logged_errors() -> Iterator[None]:
    """Raise the first error that LeRobot logs: its threads log an image that could not be written and go on.

    Raises:
        RuntimeError: with the logged message.
    """
    handler = _ErrorCollector()
    logger = logging.getLogger("lerobot.datasets")
    logger.addHandler(handler)
    logger.propagate = False
    try:
        yield
    except (OSError, RuntimeError) as error:
        # a later error may only be its consequence: an image that cannot be read
        raise RuntimeError(handler.errors[0] if handler.errors else str(error)) from error
    finally:
        logger.removeHandler(handler)
        logger.propagate = True
    if handler.errors:
        raise RuntimeError(handler.errors[0])


class _ErrorCollector(logging.Handler):
    """Keeps errors and passes other messages on."""

    def __init__(self) -> None:
        super().__init__()
        self.errors: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno >= logging.ERROR:
            self.errors.append(record.getMessage())
        else:
            logging.getLogger().handle(record)


def _write_episodes(dataset: LeRobotDataset, episodes: Iterable[RecordedEpisode]) -> list[dict[str, Any]]:
    """Write all episodes, finish the dataset, and return the episodes' columns."""
    rows = []
    try:
        for episode in episodes:
            _write_episode(dataset, episode)
            rows.append(episode.columns)
        dataset.finalize()
    except BaseException:
        abandon(dataset)  # its folder may be deleted next
        raise
    return rows


def _write_episode(dataset: LeRobotDataset, episode: RecordedEpisode) -> None:
    for frame in episode.frames:
        dataset.add_frame(frame)
    dataset.save_episode()


def _add_episode_columns(root: Path, rows: list[dict[str, Any]]) -> None:
    """Add the columns of each episode to LeRobot's table of episodes.

    Columns follow their episodes through load, filter, merge and push; a file beside the table would
    be separated from them by a merge.
    """
    path = root / DEFAULT_EPISODES_PATH.format(chunk_index=0, file_index=0)
    table = pq.read_table(path)
    for name in rows[0]:
        table = table.append_column(name, pa.array([row[name] for row in rows]))
    unfinished = path.with_suffix(".tmp")
    pq.write_table(table, unfinished)
    unfinished.replace(path)


def check_encoded_frames(root: Path, cameras: Sequence[str], num_frames: int) -> None:
    """Raise a RuntimeError if the encoder dropped frames or did not finish them, which LeRobot only logs."""
    encoded = dict.fromkeys(cameras, 0)
    for path in sorted(root.glob("videos/*/*/*.mp4")):
        with av.open(str(path)) as video:
            camera = path.parts[-3]
            encoded[camera] += video.streams.video[0].frames
    for camera, num_encoded in encoded.items():
        if num_encoded != num_frames:
            raise RuntimeError(f"the video of {camera} has {num_encoded} frames instead of {num_frames}")
