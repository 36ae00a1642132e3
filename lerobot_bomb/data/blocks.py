"""Blocks of a recording: small finished LeRobotDatasets, merged into one at the end.

LeRobot's parquet files can be read only after `finalize`, so a dataset that is killed while it is
written is lost. Blocks bound that loss to the episodes of one block, which are played again.
"""

import json
import logging
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import pyarrow as pa
import pyarrow.parquet as pq
from av.logging import WARNING, set_libav_level
from datasets import disable_progress_bars, enable_progress_bars
from datasets.exceptions import DatasetGenerationError
from lerobot.datasets import LeRobotDataset, aggregate_datasets
from lerobot.datasets.utils import DEFAULT_EPISODES_PATH, STATS_PATH
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_PREFIX, OBS_STATE

from lerobot_bomb import __version__
from lerobot_bomb._compat import (
    abandon,
    datasets_cache,
    mergeable_arrays,
    sampled_image_statistics,
    without_statistics,
)
from lerobot_bomb.camera_geometry import geometry_shapes
from lerobot_bomb.data.rollout import Rollout
from lerobot_bomb.schema import (
    ACTION_NAMES,
    CAMERAS,
    PROTOCOL_VERSION,
    STATE_NAMES,
    EpisodeResult,
    EpisodeSpec,
    RenderOptions,
)

ENCODER_THREADS = 1  # per camera, which keeps two cores busy; see benchmarks/record_speed.py
IMAGE_WRITER_THREADS = 4


@dataclass(frozen=True)
class DatasetLayout:
    """What a block and the merged dataset have in common."""

    repo_id: str
    spec: EpisodeSpec
    render_options: RenderOptions
    use_videos: bool

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        """LeRobot's features under the environment's policy-side keys; never `environment_state`."""
        size = self.render_options.image_size
        dtype = "video" if self.use_videos else "image"
        image = {"dtype": dtype, "shape": (size, size, 3), "names": ["height", "width", "channels"]}
        action_names = ACTION_NAMES[self.spec.control_mode]
        return {
            **{f"{OBS_IMAGES}.{camera}": dict(image) for camera in CAMERAS},
            OBS_STATE: {"dtype": "float32", "shape": (len(STATE_NAMES),), "names": list(STATE_NAMES)},
            ACTION: {"dtype": "float32", "shape": (len(action_names),), "names": list(action_names)},
            **self.geometry_features,
        }

    @property
    def geometry_features(self) -> dict[str, dict[str, Any]]:
        """Depth, intrinsics and extrinsics as arrays: a policy would take images of them for cameras."""
        return {
            f"{OBS_PREFIX}{key}": {"dtype": "float32", "shape": shape, "names": ["row", "column"]}
            for key, shape in geometry_shapes(self.render_options).items()
        }

    def create(self, root: Path) -> LeRobotDataset:
        """An empty dataset that is ready to be written."""
        return LeRobotDataset.create(
            self.repo_id,
            fps=self.spec.fps,
            features=self.features,
            root=root,
            # LeRobot's merge refuses datasets of different robots, hence of different protocol versions too
            robot_type=f"bomb_{self.spec.robot}_v{PROTOCOL_VERSION}",
            use_videos=self.use_videos,
            streaming_encoding=self.use_videos,
            # unlimited: LeRobot drops frames when this queue is full
            encoder_queue_maxsize=0,
            encoder_threads=ENCODER_THREADS,
            video_backend="pyav",  # for reading; LeRobot's probe of torchcodec prints a page where it fails
            image_writer_threads=0 if self.use_videos else IMAGE_WRITER_THREADS,
        )


def write_block(layout: DatasetLayout, root: Path, rollouts: Iterable[Rollout]) -> int:
    """Write rollouts as a finished LeRobotDataset and return its number of frames.

    Raises:
        RuntimeError: a video lacks frames, or a thread of LeRobot could not write an image or a video.
        OSError: the disk is full.
    """
    with (
        _quiet_libraries(),
        _temporary_files_in(root.parent),
        sampled_image_statistics(),
        without_statistics(layout.geometry_features),
        _logged_errors(),
    ):
        results = _write_episodes(layout.create(root), rollouts)
    _add_episode_columns(root, results)
    num_frames = sum(result.steps for result in results)
    _check_videos(root, num_frames)
    return num_frames


def merge_blocks(layout: DatasetLayout, blocks: list[Path], root: Path) -> None:
    """Merge finished blocks, in their order, into one dataset.

    Videos and tables are joined up to LeRobot's file sizes. Tables that hold images or depth stay one per
    block: to join them LeRobot would read and write all earlier images again for every block.

    Raises:
        OSError: the disk is full.
    """
    repo_ids = [layout.repo_id] * len(blocks)
    cache = datasets_cache(root.with_name(f"{root.name}.cache"))
    depth = layout.render_options.depth
    arrays = mergeable_arrays(layout.features) if depth else nullcontext()
    with _quiet_libraries(), _temporary_files_in(root.parent), cache, arrays:
        try:
            aggregate_datasets(
                repo_ids,
                layout.repo_id,
                roots=blocks,
                aggr_root=root,
                concatenate_data=layout.use_videos and not depth,
            )
        except DatasetGenerationError as error:
            raise OSError(f"the blocks could not be read: {error.__cause__}") from error
    # LeRobot writes the keys in the order of a set, which differs from run to run
    stats = root / STATS_PATH
    stats.write_text(json.dumps(json.loads(stats.read_text()), indent=4, sort_keys=True))


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
def _temporary_files_in(folder: Path) -> Iterator[None]:
    """Let LeRobot join videos here, not in the system's folder, where a kill would leave them."""
    usual = tempfile.tempdir
    tempfile.tempdir = str(folder)
    try:
        yield
    finally:
        tempfile.tempdir = usual


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
        # what is raised later may only be its consequence: an image that cannot be read
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


def _write_episodes(dataset: LeRobotDataset, rollouts: Iterable[Rollout]) -> list[EpisodeResult]:
    results = []
    try:
        for rollout in rollouts:
            _write_episode(dataset, rollout)
            results.append(rollout.result)
        dataset.finalize()
    except BaseException:
        abandon(dataset)  # its folder may be deleted next
        raise
    return results


def _write_episode(dataset: LeRobotDataset, rollout: Rollout) -> None:
    for step, (state, action) in enumerate(zip(rollout.states, rollout.actions, strict=True)):
        images = {f"{OBS_IMAGES}.{camera}": frames[step] for camera, frames in rollout.frames.items()}
        geometry = {f"{OBS_PREFIX}{key}": values[step] for key, values in rollout.geometry.items()}
        dataset.add_frame(
            {**images, **geometry, OBS_STATE: state, ACTION: action, "task": rollout.result.instruction},
        )
    dataset.save_episode()


def _add_episode_columns(root: Path, results: list[EpisodeResult]) -> None:
    """Add what determines each episode to LeRobot's table of episodes.

    Columns follow their episodes through load, filter, merge and push; a file beside the table would
    be separated from them by a merge.
    """
    path = root / DEFAULT_EPISODES_PATH.format(chunk_index=0, file_index=0)
    columns = {
        "bomb/seed": pa.array([result.spec.seed for result in results]),
        "bomb/target": pa.array([list(result.target) for result in results]),
        "bomb/color": pa.array([result.color for result in results]),
        "bomb/levels": pa.array([json.dumps(result.levels) for result in results]),
        "bomb/spec": pa.array([json.dumps(result.spec.to_dict()) for result in results]),
        "bomb/protocol_version": pa.array([result.protocol_version for result in results]),
        "bomb/package_version": pa.array([__version__] * len(results)),
    }
    table = pq.read_table(path)
    for name, column in columns.items():
        table = table.append_column(name, column)
    unfinished = path.with_suffix(".tmp")
    pq.write_table(table, unfinished)
    unfinished.replace(path)


def _check_videos(root: Path, num_frames: int) -> None:
    """LeRobot logs frames that its encoder drops or does not finish; here they are an error."""
    encoded: dict[str, int] = {}
    for path in sorted(root.glob("videos/*/*/*.mp4")):
        with av.open(str(path)) as video:
            camera = path.parts[-3]
            encoded[camera] = encoded.get(camera, 0) + video.streams.video[0].frames
    for camera, num_encoded in encoded.items():
        if num_encoded != num_frames:
            raise RuntimeError(f"the video of {camera} has {num_encoded} frames instead of {num_frames}")
