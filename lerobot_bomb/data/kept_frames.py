"""Samples of a dataset of images, read from memory."""

import os
from functools import cached_property
from typing import Any

import datasets
import torch
from torch import Tensor
from torch.utils.data import get_worker_info

MEMORY_SHARE = 1 / 4  # of the machine's memory, for the images that all workers keep


def keep_frames(frames: datasets.Dataset) -> "datasets.Dataset | KeptFrames":
    """Keep a dataset's frames in memory if they hold images; those of videos are no part of them."""
    has_images = any(isinstance(feature, datasets.Image) for feature in frames.features.values())
    return KeptFrames(frames) if has_images else frames


class KeptFrames:
    """Frames in the place of a Hugging Face dataset that LeRobot reads: the same values, sooner.

    Numbers are tensors from the first sample on. An image is decoded where it is asked for, and kept as
    bytes while there is memory. Whatever else a dataset can do is done by the original.
    """

    def __init__(self, frames: datasets.Dataset) -> None:
        self._frames = frames
        self._kept: dict[tuple[str, int], Tensor] = {}
        self._free: float | None = None  # bytes; the number of workers is known with the first image

    def __len__(self) -> int:
        return len(self._frames)

    def __getattr__(self, name: str) -> Any:
        if name == "_frames":  # not yet there, while it is unpickled
            raise AttributeError(name)
        return getattr(self._frames, name)

    def __getstate__(self) -> dict[str, Any]:
        """Leave what is kept behind: a worker process keeps its own."""
        return {"_frames": self._frames, "_kept": {}, "_free": None}

    def __getitem__(self, at: Any) -> Any:
        """Return a frame, as {column: value}, or a column; of other questions the original's answer."""
        if isinstance(at, str):
            return _Column(self, at)
        if not isinstance(at, int):
            return self._frames[at]
        rest = {} if self._rest is None else self._rest[at]
        return {key: rest[key] if key in rest else self.value(key, at) for key in self.column_names}

    def value(self, key: str, row: int) -> Tensor:
        """Return a number or an image of one frame."""
        return self._numbers[key][row].clone() if key in self._numbers else self._image(key, row)

    @cached_property
    def _columns(self) -> dict[str, datasets.Dataset]:
        keys = [key for key, feature in self.features.items() if isinstance(feature, datasets.Image)]
        return {key: self._frames.select_columns(key) for key in keys}

    @cached_property
    def _numbers(self) -> dict[str, Tensor]:
        keys = [key for key in self.column_names if _is_numeric(self.features[key])]
        columns = self._frames.select_columns(keys).with_format("torch")[:]
        return {key: value for key, value in columns.items() if isinstance(value, Tensor)}

    @cached_property
    def _rest(self) -> datasets.Dataset | None:
        keys = [key for key in self.column_names if key not in self._numbers and key not in self._columns]
        return self._frames.select_columns(keys) if keys else None

    def _image(self, key: str, row: int) -> Tensor:
        if (key, row) in self._kept:
            kept = self._kept[key, row]
            return kept.float().div(255) if kept.dtype == torch.uint8 else kept.clone()
        image = self._columns[key][row][key]
        if self._free is None:
            worker = get_worker_info()
            memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
            self._free = MEMORY_SHARE * memory / (worker.num_workers if worker else 1)
        levels = (255 * image).round().to(torch.uint8)
        kept = levels if torch.equal(levels.float().div(255), image) else image.clone()  # depth, in metres
        if kept.nbytes <= self._free:
            self._free -= kept.nbytes
            self._kept[key, row] = kept
        return image


class _Column:
    """A column, of which LeRobot asks some rows."""

    def __init__(self, frames: KeptFrames, key: str) -> None:
        self._frames, self._key = frames, key

    def __getitem__(self, rows: Any) -> Any:
        frames, key = self._frames, self._key
        columns: Any = frames._frames
        is_kept = isinstance(rows, list) and (key in frames._numbers or key in frames._columns)
        return [frames.value(key, row) for row in rows] if is_kept else columns[key][rows]


def _is_numeric(feature: Any) -> bool:
    while isinstance(feature, datasets.List | datasets.LargeList):
        feature = feature.feature
    dtype = getattr(feature, "dtype", "")
    return dtype == "bool" or dtype.startswith(("int", "uint", "float"))
