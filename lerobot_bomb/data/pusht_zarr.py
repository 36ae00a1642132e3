"""The PushT demonstrations of Diffusion Policy as they are published: a folder in zarr's format 2.

Reads and checks data/img (N, 96, 96, 3), whole numbers in 0..255, RGB; data/state (N, 5), the agent's x and y
in pixels of the 512x512 board, then the block's pose; data/action (N, 2), the agent's target x and y in the
same pixels; meta/episode_ends (E), the first frame after each episode.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from lerobot_bomb.pusht.episode import BOARD_PX

IMAGE_SIZE = 96  # pixels
BOARD_SIZE = float(BOARD_PX)  # the unit of state and action


@dataclass(frozen=True)
class _Layout:
    """Layout that an array must have."""

    shape: tuple[int, ...]  # without the frames
    allowed: str
    are_allowed: Callable[[np.ndarray], np.ndarray]  # block -> where its values are allowed


def _on_board(positions: np.ndarray) -> np.ndarray:
    return (positions >= 0) & (positions <= BOARD_SIZE)


def _is_state(states: np.ndarray) -> np.ndarray:
    allowed = np.isfinite(states)
    allowed[:, :2] &= _on_board(states[:, :2])
    return allowed


ARRAYS = {
    "data/img": _Layout(
        (IMAGE_SIZE, IMAGE_SIZE, 3),
        "whole numbers in 0..255",
        lambda pixels: (pixels >= 0) & (pixels <= 255) & (pixels == np.round(pixels)),
    ),
    "data/state": _Layout((5,), "finite numbers, of which the first two lie in 0..512", _is_state),
    "data/action": _Layout((2,), "numbers in 0..512", _on_board),
}
ENDS = "meta/episode_ends"


class PushtZarr:
    """The demonstrations in a folder; `check` must have passed before they are read.

    Raises:
        ValueError: the folder is no zarr of format 2, or lacks what PushT has; names what and where.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        _check_format(path)
        self._arrays = {name: self._open(name) for name in (*ARRAYS, ENDS)}
        self.ends = self._read_ends()
        for name, layout in ARRAYS.items():
            shape = (self.num_frames, *layout.shape)
            if self._arrays[name].shape != shape:
                raise ValueError(
                    f"{path / name} has the shape {self._arrays[name].shape}, but PushT whose last episode "
                    f"ends at frame {self.num_frames} has {shape}"
                )

    @property
    def num_episodes(self) -> int:
        return len(self.ends)

    @property
    def num_frames(self) -> int:
        return int(self.ends[-1])

    @cached_property
    def sha256(self) -> str:
        """SHA-256 of all files that are read."""
        digest = hashlib.sha256()
        for name in (*ARRAYS, ENDS):
            for file in sorted(path for path in (self.path / name).rglob("*") if path.is_file()):
                content = file.read_bytes()
                digest.update(f"{file.relative_to(self.path).as_posix()} {len(content)}\n".encode())
                digest.update(content)
        return digest.hexdigest()

    def check(self) -> None:
        """Read and check every chunk once.

        Raises:
            ValueError: names the file that is missing or cannot be decoded, or holds what PushT cannot have.
        """
        chunks = [(name, chunk) for name in ARRAYS for chunk in np.ndindex(self._arrays[name].cdata_shape)]
        for name, chunk in chunks:
            self._present_file(name, chunk)
        for name, chunk in tqdm(chunks, desc="checking", unit="chunk"):
            block, layout = self._read_chunk(name, chunk), ARRAYS[name]
            allowed = layout.are_allowed(block)
            if not allowed.all():
                value = block[~allowed][0]
                raise ValueError(f"{self._file(name, chunk)} holds {value}, but PushT has {layout.allowed}")

    def episode(self, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Images (T, 96, 96, 3) uint8 RGB; the agent's positions and actions, both (T, 2) float32 pixels."""
        steps = slice(int(self.ends[index - 1]) if index else 0, int(self.ends[index]))
        images, states, actions = (self._arrays[name][steps] for name in ARRAYS)
        return images.astype(np.uint8), states[:, :2].astype(np.float32), actions.astype(np.float32)

    def _open(self, name: str) -> Any:
        zarr = _import_zarr()
        if not (self.path / name / ".zarray").is_file():
            raise ValueError(f"{self.path} holds no array {name}, so it is not PushT")
        try:
            return zarr.open_array(self.path / name, mode="r", zarr_format=2)
        except Exception as error:  # of whatever type the broken metadata leads to
            raise ValueError(f"{self.path / name / '.zarray'} cannot be read: {error}") from error

    def _read_ends(self) -> np.ndarray:
        """Check and read meta/episode_ends: (E) whole numbers."""
        array, file = self._arrays[ENDS], self.path / ENDS
        if array.ndim != 1 or array.dtype.kind not in "iu" or array.shape[0] == 0:
            raise ValueError(
                f"{file} has shape {array.shape} of {array.dtype}; it must be whole numbers in a row"
            )
        ends = np.concatenate([self._read_chunk(ENDS, chunk) for chunk in np.ndindex(array.cdata_shape)])
        if ends[0] < 1 or (np.diff(ends.astype(np.int64)) < 1).any():
            raise ValueError(f"{file} must increase from episode to episode; it holds {ends.tolist()}")
        return ends

    def _read_chunk(self, name: str, chunk: tuple[int, ...]) -> np.ndarray:
        """Read the values of one chunk; zarr itself takes a missing file for zeros."""
        file = self._present_file(name, chunk)
        try:
            return np.asarray(self._arrays[name].get_block_selection(chunk))
        except Exception as error:  # of whatever type the codec has
            raise ValueError(f"{file} cannot be decoded ({error}); get the data again") from error

    def _present_file(self, name: str, chunk: tuple[int, ...]) -> Path:
        file = self._file(name, chunk)
        if not file.is_file():
            raise ValueError(f"{file} is missing, so frames are lost; get the data again")
        return file

    def _file(self, name: str, chunk: tuple[int, ...]) -> Path:
        return self.path / name / self._arrays[name].metadata.encode_chunk_key(chunk)


def _check_format(path: Path) -> None:
    if (path / "zarr.json").exists():
        raise ValueError(f"{path} is a zarr of format 3; PushT is published in format 2, with a file .zgroup")
    if not (path / ".zgroup").is_file():
        raise ValueError(f"{path} is no zarr: it must be a folder that holds .zgroup, data and meta")


def _import_zarr() -> Any:
    try:
        import zarr
    except ImportError as error:
        raise RuntimeError(f"{error}: run pip install zarr") from error
    return zarr
