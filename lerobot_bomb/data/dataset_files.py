"""Checks that a LeRobotDataset v3's files are whole and agree with its metadata; imports no torch."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from av.error import FFmpegError

from lerobot_bomb.files import read_json

INFO_FILE = Path("meta") / "info.json"
STATISTICS_FILE = Path("meta") / "stats.json"
TASKS_FILE = Path("meta") / "tasks.parquet"
EPISODES_FOLDER = Path("meta") / "episodes"
COUNTS = ("total_episodes", "total_frames", "total_tasks")
STATISTICS = ("mean", "std", "min", "max")
PICTURES = ("image", "video")
WAY_OUT = "copy the dataset again from where it is whole, or record it again"

type Info = dict[str, Any]


def check_dataset(root: Path) -> None:
    """Check that every file is there, whole and finite, and holds the episodes and frames of info.json.

    The first and the last frame of each video are decoded, and its frames counted.

    Raises:
        ValueError: names the file and what is wrong with it.
    """
    try:
        info = read_info(root)
        _check_tasks(root, info)
        _check_statistics(root, info)
        episodes = read_episodes(root, info)
        _check_data(root, info, episodes)
        check_videos(root, info, episodes)
    except (OSError, ValueError) as error:
        raise ValueError(f"{error}; {WAY_OUT}") from error


def check_metadata(root: Path) -> None:
    """Check that the files under meta/ can be read; datasets of other people promise no more.

    Raises:
        ValueError: names the one that is truncated.
    """
    for path in (root / INFO_FILE, root / STATISTICS_FILE):
        if path.is_file():
            read_json(path)
    for path in (root / TASKS_FILE, *sorted((root / EPISODES_FOLDER).rglob("*.parquet"))):
        if path.is_file():
            read_parquet(path)


def check_readable(root: Path) -> None:
    """Check that all tables and videos on this machine are whole; LeRobot downloads the others.

    Raises:
        ValueError: names the file that is truncated.
    """
    for path in sorted((root / "data").rglob("*.parquet")):
        read_parquet(path, ["index"])
    info = read_info(root)
    with suppress(FileNotFoundError):
        check_videos(root, info, read_episodes(root, info))


def read_info(root: Path) -> Info:
    """Read info.json of a dataset, and check its counts, rate and features.

    Raises:
        OSError, ValueError: the file is missing or truncated, or lacks one of these.
    """
    info = read_json(root / INFO_FILE)
    features = info.get("features")
    is_whole = (
        all(type(info.get(name)) is int and info[name] > 0 for name in COUNTS)
        and isinstance(info.get("fps"), int | float)
        and info["fps"] > 0
        and isinstance(features, dict)
        and all({"dtype", "shape"} <= set(feature) for feature in features.values())
    )
    if not is_whole:
        names = ", ".join(COUNTS)
        raise ValueError(f"{root / INFO_FILE} does not say {names} (at least 1 each), fps and the features")
    return info


def read_parquet(path: Path, columns: Sequence[str] | None = None, filters: list | None = None) -> pa.Table:
    """Read a table, or some of its columns, or the rows that pass pyarrow's filters.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is truncated, of another format, or lacks a column.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing")
    try:
        # a folder NAME=VALUE above is no column
        table = pq.read_table(path, columns=columns, filters=filters, partitioning=None)  # pyright: ignore
    except (pa.ArrowException, OSError) as error:
        reason = str(error).splitlines()[0].rpartition("': ")[2]  # without the path
        raise ValueError(f"{path} is truncated or no parquet file: {reason}") from None
    absent = sorted(set(columns or ()) - set(table.column_names))
    if absent:
        raise ValueError(f"{path} has no column {absent[0]}")
    return table


def check_video(path: Path, num_frames: int, fps: float) -> None:
    """Check that a video has this number of frames, and that the first and the last can be decoded.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is truncated, or has another number of frames.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing")
    try:
        with av.open(str(path)) as video:
            stream = video.streams.video[0]
            num_found = sum(packet.size > 0 and not packet.is_corrupt for packet in video.demux(stream))
            video.seek(0)
            next(video.decode(stream))
            assert stream.time_base is not None
            video.seek(int((num_found - 1) / fps / stream.time_base), stream=stream)
            last_s = [frame.time for frame in video.decode(stream)][-1]
    except (FFmpegError, IndexError, StopIteration) as error:
        reason = str(error).splitlines()[:1] or ["it has no frames"]
        raise ValueError(f"{path} is truncated or no video: {reason[0]}") from None
    if num_found != num_frames or last_s is None or round(last_s * fps) != num_frames - 1:
        raise ValueError(f"{path} has {num_found} whole frames, not the {num_frames} of its episodes")


def episode_tables(root: Path) -> list[pa.Table]:
    """Read the files of LeRobot's table of episodes, in their order; [] if there is none.

    Raises:
        ValueError: a file is truncated, or of another format.
    """
    return [read_parquet(path) for path in sorted((root / EPISODES_FOLDER).rglob("*.parquet"))]


def read_episodes(root: Path, info: Info) -> pa.Table:
    """Read the table of episodes, in the order of their index.

    Raises:
        OSError, ValueError: a file is missing or damaged, or the episodes are not those of info.json.
    """
    tables = episode_tables(root)
    if not tables:
        raise FileNotFoundError(f"{root / EPISODES_FOLDER} holds no table of episodes")
    try:
        episodes = pa.concat_tables(tables, promote_options="default")
        lengths = episodes["length"].to_numpy()
        ends = lengths.cumsum()
        expected = {
            "episode_index": np.arange(info["total_episodes"]),
            "dataset_from_index": ends - lengths,
            "dataset_to_index": ends,
        }
        found = {name: episodes[name].to_numpy() for name in expected}
    except (pa.ArrowException, KeyError) as error:
        raise ValueError(f"{root / EPISODES_FOLDER} is no table of episodes: {error}") from None
    if len(episodes) != info["total_episodes"] or ends[-1] != info["total_frames"]:
        raise ValueError(
            f"{root / EPISODES_FOLDER} holds {len(episodes)} episodes of {ends[-1]} frames, {INFO_FILE} says "
            f"{info['total_episodes']} of {info['total_frames']}"
        )
    for name, values in expected.items():
        if not np.array_equal(found[name], values):
            raise ValueError(f"{root / EPISODES_FOLDER}: {name} does not follow from the episodes before")
    check_finite_columns(root / EPISODES_FOLDER, episodes)
    return episodes


def check_videos(root: Path, info: Info, episodes: pa.Table) -> None:
    """Check that the videos of all cameras hold the episodes' frames, one episode after the other.

    Raises:
        OSError, ValueError: names the file.
    """
    for name, feature in info["features"].items():
        if feature["dtype"] != "video":
            continue
        for path, indices in _files(root, info, "video_path", episodes, f"videos/{name}/", name):
            rows = episodes.take(indices)
            ends = rows["length"].to_numpy().cumsum()
            found = _column(rows, f"videos/{name}/to_timestamp", root) * info["fps"]
            starts = _column(rows, f"videos/{name}/from_timestamp", root) * info["fps"]
            if not np.array_equal(np.rint([starts, found]), [ends - rows["length"].to_numpy(), ends]):
                raise ValueError(f"{root / EPISODES_FOLDER}: episodes do not follow one another in {path}")
            check_video(path, int(ends[-1]), info["fps"])


def check_finite_columns(path: Path, table: pa.Table) -> None:
    """Raise a ValueError that names the first column of floats that are not all finite, and the row."""
    for name in table.column_names:
        values = flat_numbers(table[name])
        if values.dtype.kind != "f" or np.isfinite(values).all():
            continue
        first = np.flatnonzero(~np.isfinite(values))[0]
        row = first * len(table) // len(values)
        raise ValueError(f"{path}: {name} is {values[first]} in row {row}, not finite")


def flat_numbers(column: pa.ChunkedArray) -> np.ndarray:
    """Flatten a column of scalars or (nested) lists into one row of values; null among floats becomes NaN."""
    array = column.combine_chunks()
    while isinstance(array, pa.ExtensionArray):
        array = array.storage
    while pa.types.is_nested(array.type):
        array = array.flatten()
    return array.to_numpy(zero_copy_only=False)


def _check_tasks(root: Path, info: Info) -> None:
    table = read_parquet(root / TASKS_FILE, ["task_index"])
    if table["task_index"].to_pylist() != list(range(info["total_tasks"])):
        raise ValueError(
            f"{root / TASKS_FILE} does not hold the tasks 0..{info['total_tasks'] - 1} of {INFO_FILE}"
        )


def _check_statistics(root: Path, info: Info) -> None:
    """Raise unless every image, number and vector has finite statistics; no policy normalises arrays."""
    path = root / STATISTICS_FILE
    statistics = read_json(path)
    for name, feature in info["features"].items():
        is_needed = feature["dtype"] in PICTURES or len(feature["shape"]) == 1
        if feature["dtype"] in ("string", "language") or not (is_needed or name in statistics):
            continue
        absent = [each for each in STATISTICS if each not in statistics.get(name, {})]
        if absent:
            raise ValueError(f"{path} has no {absent[0]} of {name}")
        for kind, values in statistics[name].items():
            try:
                is_finite = np.isfinite(np.asarray(values, dtype=np.float64)).all()
            except (TypeError, ValueError):
                is_finite = False
            if not is_finite:
                raise ValueError(f"{path}: {kind} of {name} is not finite")


def _check_data(root: Path, info: Info, episodes: pa.Table) -> None:
    """Check that each data file holds the frames of its episodes, in order, with finite numbers."""
    columns = [
        name
        for name, feature in info["features"].items()
        if feature["dtype"] not in (*PICTURES, "string", "language") and len(feature["shape"]) == 1
    ]
    num_frames, files = 0, _files(root, info, "data_path", episodes, "data/")
    for path, indices in files:
        rows = episodes.take(indices)
        table = read_parquet(path, columns)
        lengths = rows["length"].to_numpy()
        if len(table) != lengths.sum():
            raise ValueError(f"{path} holds {len(table)} frames, not the {lengths.sum()} of its episodes")
        expected = {
            "index": num_frames + np.arange(len(table)),
            "episode_index": np.repeat(rows["episode_index"].to_numpy(), lengths),
            "frame_index": np.concatenate([np.arange(length) for length in lengths]),
        }
        for name, values in expected.items():
            if not np.array_equal(_column(table, name, path), values):
                raise ValueError(f"{path}: {name} does not count the frames of its episodes")
        if not np.isin(_column(table, "task_index", path), np.arange(info["total_tasks"])).all():
            raise ValueError(f"{path}: task_index is not one of {TASKS_FILE}")
        check_finite_columns(path, table)
        num_frames += len(table)
    strangers = set((root / "data").rglob("*.parquet")) - {path for path, _ in files}
    if strangers:
        raise ValueError(f"{min(strangers)} is of no episode, but LeRobot would read it")


def _files(
    root: Path, info: Info, template: str, episodes: pa.Table, prefix: str, video_key: str | None = None
) -> list[tuple[Path, np.ndarray]]:
    """Return the path of each file of a kind, in order, with the rows of its episodes in their table."""
    chunks = _column(episodes, f"{prefix}chunk_index", root)
    files = _column(episodes, f"{prefix}file_index", root)
    found = []
    for chunk, file in sorted(set(zip(chunks.tolist(), files.tolist(), strict=True))):
        try:
            name = info[template].format(video_key=video_key, chunk_index=chunk, file_index=file)
        except (AttributeError, IndexError, KeyError, ValueError):
            raise ValueError(f"{root / INFO_FILE}: {template} is no template of LeRobot's") from None
        found.append((root / name, np.flatnonzero((chunks == chunk) & (files == file))))
    return found


def _column(table: pa.Table, name: str, path: Path) -> np.ndarray:
    if name not in table.column_names:
        raise ValueError(f"{path} has no column {name}")
    return table[name].to_numpy()
