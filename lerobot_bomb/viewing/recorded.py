"""Episodes of a recorded dataset, drawn as a contact sheet or a video; needs neither display nor LeRobot."""

import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
from av.error import FFmpegError
from PIL import Image

from lerobot_bomb.bomb.environment import IMAGES
from lerobot_bomb.data.dataset_files import INFO_FILE, PICTURES, Info, read_episodes, read_info, read_parquet
from lerobot_bomb.files import read_json
from lerobot_bomb.viewing.sheet import Sheet, caption, text_tile
from lerobot_bomb.viewing.video import VideoFile

VERSION = "v3"  # of LeRobot's datasets
TILE_HEIGHT = 160  # pixels
VIDEO_HEIGHT = 256  # pixels of each camera's image
MIN_WIDTH = 480  # pixels of a video, for its text
LABEL_WIDTH = 90  # pixels
MOMENTS = ("first", "middle", "last")


@dataclass(frozen=True)
class ViewedDataset:
    """A LeRobotDataset v3 in a folder, of images or videos."""

    root: Path
    info: Info
    episodes: pa.Table

    @classmethod
    def read(cls, root: Path) -> "ViewedDataset":
        """Read the metadata.

        Raises:
            ValueError: the folder holds no LeRobotDataset v3, a damaged one, or one without images.
        """
        if not (root / INFO_FILE).is_file():
            raise ValueError(f"{root} holds no {INFO_FILE}, so it is no LeRobotDataset")
        version = str(read_json(root / INFO_FILE).get("codebase_version"))
        if not version.startswith(VERSION):
            raise ValueError(
                f"{root} is a LeRobotDataset {version}; convert it to {VERSION} with LeRobot first"
            )
        try:
            info = read_info(root)
            dataset = cls(root, info, read_episodes(root, info))
        except OSError as error:
            raise ValueError(str(error)) from None
        if not dataset.cameras:
            raise ValueError(f"{root} has no images: its features are {', '.join(info['features'])}")
        return dataset

    @cached_property
    def cameras(self) -> list[str]:
        """Names of the features that are colour images."""
        return [
            name
            for name, feature in self.info["features"].items()
            if feature["dtype"] in PICTURES and not _is_depth(feature)
        ]

    def num_frames(self, episode: int) -> int:
        return int(self._value(episode, "length"))

    def task(self, episode: int) -> str:
        """Return the episode's instruction; several are joined."""
        return "; ".join(self._value(episode, "tasks") or [])

    def images(self, episode: int, camera: str, frames: Sequence[int]) -> Iterator[np.ndarray]:
        """Yield these frames of a camera, in rising order, (H, W, 3) uint8.

        Raises:
            ValueError: a file is missing or damaged.
        """
        is_video = self.info["features"][camera]["dtype"] == "video"
        try:
            yield from (self._from_video if is_video else self._from_table)(episode, camera, frames)
        except OSError as error:
            raise ValueError(f"{self.root}: episode {episode}, {camera}: {error}") from None

    def _from_table(self, episode: int, camera: str, frames: Sequence[int]) -> Iterator[np.ndarray]:
        path = self._path("data_path", episode, "data/")
        table = read_parquet(path, [camera, "frame_index"], filters=[("episode_index", "==", episode)])
        rows = {index: row for row, index in enumerate(table["frame_index"].to_pylist())}
        for frame in frames:
            if frame not in rows:
                raise ValueError(f"{path} lacks frame {frame} of episode {episode}")
            image: Any = table[camera][rows[frame]].as_py()
            source = io.BytesIO(image["bytes"]) if image.get("bytes") else self.root / str(image.get("path"))
            yield np.asarray(Image.open(source).convert("RGB"))

    def _from_video(self, episode: int, camera: str, frames: Sequence[int]) -> Iterator[np.ndarray]:
        path = self._path("video_path", episode, f"videos/{camera}/", camera)
        if not path.is_file():
            raise ValueError(f"{path} is missing")
        start_s = float(self._value(episode, f"videos/{camera}/from_timestamp"))
        try:
            yield from _decoded(path, start_s, frames, self.info["fps"])
        except (FFmpegError, IndexError, StopIteration) as error:
            raise ValueError(f"{path} is truncated or no video: {error}") from None

    def _path(self, template: str, episode: int, prefix: str, video_key: str | None = None) -> Path:
        numbers = {name: self._value(episode, f"{prefix}{name}") for name in ("chunk_index", "file_index")}
        return self.root / str(self.info[template]).format(video_key=video_key, **numbers)

    def _value(self, episode: int, column: str) -> Any:
        if column not in self.episodes.column_names:
            raise ValueError(f"{self.root}: the table of episodes has no column {column}")
        return self.episodes[column][episode].as_py()


def _is_depth(feature: dict[str, Any]) -> bool:
    return any(name.endswith("is_depth_map") and value for name, value in (feature.get("info") or {}).items())


def _decoded(path: Path, start_s: float, frames: Sequence[int], fps: float) -> Iterator[np.ndarray]:
    """Yield frames of the episode that starts at `start_s` of a video; it is searched only across gaps."""
    with av.open(str(path)) as file:
        stream = file.streams.video[0]
        assert stream.time_base is not None
        decoded, last = iter(()), None
        for frame in frames:
            time_s = start_s + frame / fps
            if last is None or frame != last + 1:
                file.seek(int(time_s / stream.time_base), stream=stream)
                decoded = file.decode(stream)
            earliest_s = time_s - 0.5 / fps
            found = next(
                (each for each in decoded if each.time is not None and each.time >= earliest_s), None
            )
            if found is None:
                raise ValueError(f"{path} ends before {time_s:.2f} s")
            yield found.to_ndarray(format="rgb24")
            last = frame


def write_sheet(dataset: ViewedDataset, episodes: Sequence[int], path: Path) -> None:
    """Write a PNG: each episode's instruction, and the first, middle and last frame of each camera."""
    rows: dict[str, list[np.ndarray]] = {}
    for episode in episodes:
        length = dataset.num_frames(episode)
        frames = [0, length // 2, length - 1]
        different = list(dict.fromkeys(frames))  # of an episode of one frame
        told = f"{dataset.task(episode)} ({length} frames, {length / dataset.info['fps']:.1f} s)"
        rows[f"episode {episode}"] = [text_tile(told, TILE_HEIGHT)]
        for camera in dataset.cameras:
            images = list(dataset.images(episode, camera, different))
            rows[f"episode {episode}"] += [images[different.index(frame)] for frame in frames]
    size = _tile_size(rows)
    fitted = {label: [_fitted(image, size) for image in row] for label, row in rows.items()}
    title = f"{dataset.root.name}: {len(episodes)} of {dataset.info['total_episodes']} episodes"
    columns = [f"{camera.removeprefix(IMAGES)}, {moment}" for camera in dataset.cameras for moment in MOMENTS]
    sheet = Sheet(title, ["instruction", *columns], images=fitted, label_width=LABEL_WIDTH)
    Image.fromarray(sheet.draw()).save(path, format="png")


def write_video(
    dataset: ViewedDataset, episodes: Sequence[int], path: Path, progress: Callable[[int], object]
) -> None:
    """Write all frames of the episodes, one after the other, cameras side by side, with their instruction."""
    size: tuple[int, int] | None = None  # of all images of a video
    with VideoFile(path, round(dataset.info["fps"])) as video:
        for episode in episodes:
            length, task = dataset.num_frames(episode), dataset.task(episode)
            cameras = [dataset.images(episode, camera, range(length)) for camera in dataset.cameras]
            for frame, images in enumerate(zip(*cameras, strict=True)):
                shown = np.hstack([_of_height(image, VIDEO_HEIGHT) for image in images])
                width = max(MIN_WIDTH, shown.shape[1])
                bar = caption(task, f"episode {episode}, frame {frame} of {length}", width)
                drawn = np.vstack([_fitted(shown, (VIDEO_HEIGHT, width)), bar])
                size = size or (drawn.shape[0], drawn.shape[1])
                video.add(_fitted(drawn, size))
            progress(episode)


def _tile_size(rows: dict[str, list[np.ndarray]]) -> tuple[int, int]:
    """Return (height, width) of tiles into which images of all cameras fit at TILE_HEIGHT."""
    shapes = [image.shape for row in rows.values() for image in row]
    return TILE_HEIGHT, max(round(TILE_HEIGHT * width / height) for height, width, _ in shapes)


def _of_height(image: np.ndarray, height: int) -> np.ndarray:
    return _fitted(image, (height, max(1, round(image.shape[1] * height / image.shape[0]))))


def _fitted(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Scale an image into (height, width), with margins where its shape is another."""
    if image.shape[:2] == size:
        return image
    height, width = size
    scale = min(height / image.shape[0], width / image.shape[1])
    inner = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
    # small images stay sharp
    method = Image.Resampling.NEAREST if scale > 1 else Image.Resampling.LANCZOS
    tile = Image.new("RGB", (width, height), (255, 255, 255))
    place = (width - inner[0]) // 2, (height - inner[1]) // 2
    tile.paste(Image.fromarray(image).resize(inner, method), place)
    return np.asarray(tile)
