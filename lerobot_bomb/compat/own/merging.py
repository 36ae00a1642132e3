"""LeRobot's merge of datasets, in a time that grows with their number and not with its square."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pandas as pd
from lerobot.datasets import aggregate
from lerobot.datasets.io_utils import get_parquet_file_size_in_mb
from lerobot.datasets.utils import update_chunk_file_indices


@contextmanager
def merged_at_once() -> Iterator[None]:
    """Let LeRobot's merge write each file of the merged dataset once.

    LeRobot's function would rewrite a file for every dataset that it adds.
    """
    tables, videos = _Tables(), _Videos()
    replaced = {
        "append_or_create_parquet_file": tables.append,
        "concatenate_video_files": videos.append,
        "get_file_size_in_mb": videos.size_mb,
    }
    for name, function in replaced.items():
        setattr(aggregate, name, function)
    try:
        yield
        tables.write_all()
        videos.write_all()
    finally:
        for name, function in (tables.usual | videos.usual).items():
            setattr(aggregate, name, function)


class _Tables:
    """Tables of data and of episodes, in memory until LeRobot begins the next file of their kind."""

    def __init__(self) -> None:
        self.usual = {"append_or_create_parquet_file": aggregate.append_or_create_parquet_file}
        self._open: dict[str, _Table] = {}  # by template of their path

    def append(
        self,
        df: pd.DataFrame,
        src_path: Path,
        idx: Any,
        max_mb: float,
        chunk_size: int,
        default_path: str,
        concatenate: bool = True,
        **options: Any,
    ) -> tuple[Any, tuple[int, int]]:
        """Stand in for `append_or_create_parquet_file`; the sizes of its sources decide when a file ends."""
        size_mb = get_parquet_file_size_in_mb(src_path)
        table = self._open.get(default_path)
        if table and (not concatenate or table.size_mb + size_mb >= max_mb):
            self._write(default_path)
            idx["chunk"], idx["file"] = update_chunk_file_indices(idx["chunk"], idx["file"], chunk_size)
        place = {"chunk": idx["chunk"], "file": idx["file"]}
        table = self._open.setdefault(default_path, _Table((src_path, place, max_mb, chunk_size), options))
        table.frames.append(df)
        table.size_mb += size_mb
        return idx, (idx["chunk"], idx["file"])

    def _write(self, default_path: str) -> None:
        table = self._open.pop(default_path)
        frames = pd.concat(table.frames, ignore_index=True) if len(table.frames) > 1 else table.frames[0]
        write: Any = self.usual["append_or_create_parquet_file"]
        write(frames, *table.arguments, default_path, **table.options)

    def write_all(self) -> None:
        for default_path in list(self._open):
            self._write(default_path)


class _Table:
    """A file that is not written yet."""

    def __init__(self, arguments: tuple[Any, ...], options: dict[str, Any]) -> None:
        self.arguments, self.options = arguments, options  # of LeRobot's function
        self.frames: list[pd.DataFrame] = []
        self.size_mb = 0.0


class _Videos:
    """Videos to join, by the video that they become."""

    def __init__(self) -> None:
        self.usual = {
            "concatenate_video_files": aggregate.concatenate_video_files,
            "get_file_size_in_mb": aggregate.get_file_size_in_mb,
        }
        self._joined: dict[Path, list[Path]] = {}
        self._sizes_mb: dict[Path, float] = {}

    def append(self, input_video_paths: list[Path], output_video_path: Path, **_: Any) -> None:
        """Stand in for `concatenate_video_files`, which joins an existing video with the next one."""
        there, following = input_video_paths
        size_mb = self.size_mb(there) + self.size_mb(following)
        self._joined.setdefault(output_video_path, [there]).append(following)
        self._sizes_mb[output_video_path] = size_mb

    def size_mb(self, path: Path) -> float:
        """Return the size of a file, present or future."""
        return self._sizes_mb.get(path) or self.usual["get_file_size_in_mb"](path)

    def write_all(self) -> None:
        for path, videos in self._joined.items():
            self.usual["concatenate_video_files"](videos, path, compatibility_check=True)
