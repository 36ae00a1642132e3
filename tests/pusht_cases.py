"""The first real PushT demonstrations as a small zarr of the same format and chunks."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zarr
from numcodecs import Blosc

ZARR = Path("pusht") / "pusht_cchi_v7_replay.zarr"  # in the shared data
NUM_EPISODES = 3
REPO_ID = "test/pusht"
ARRAYS = ("data/img", "data/state", "data/action")
ENDS = "meta/episode_ends"


@dataclass(frozen=True)
class Demonstrations:
    """What the zarr holds, read with zarr alone."""

    images: np.ndarray
    states: np.ndarray
    actions: np.ndarray
    ends: np.ndarray

    @classmethod
    def read(cls, path: Path, num_episodes: int) -> "Demonstrations":
        group = zarr.open_group(path, mode="r")
        ends = np.asarray(group[ENDS])[:num_episodes]
        return cls(*(np.asarray(group[name][: ends[-1]]) for name in ARRAYS), ends)  # type: ignore[index]

    def write(self, path: Path) -> None:
        arrays = (self.images, self.states, self.actions, self.ends)
        write_zarr(path, dict(zip((*ARRAYS, ENDS), arrays, strict=True)))


def write_zarr(path: Path, arrays: dict[str, np.ndarray], zarr_format: int = 2) -> None:
    group = zarr.open_group(path, mode="w", zarr_format=zarr_format)  # type: ignore[arg-type]
    for name, values in arrays.items():
        chunks = (161, *values.shape[1:])
        compressor = Blosc("zstd", clevel=5, shuffle=2)
        options = {"compressors": compressor} if zarr_format == 2 else {}
        array = group.create_array(name, shape=values.shape, chunks=chunks, dtype=values.dtype, **options)
        array[:] = values
