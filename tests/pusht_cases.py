"""The first real PushT demonstrations as a small zarr of the same format and chunks."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from numcodecs import Blosc

ZARR = Path("pusht") / "pusht_cchi_v7_replay.zarr"  # in the shared data
NUM_EPISODES = 3
REPO_ID = "test/pusht"
ARRAYS = ("data/img", "data/state", "data/action")
ENDS = "meta/episode_ends"


@dataclass(frozen=True)
class Demonstrations:
    """Demonstrations that the zarr holds, read with zarr alone."""

    images: np.ndarray
    states: np.ndarray
    actions: np.ndarray
    ends: np.ndarray

    @classmethod
    def read(cls, path: Path, episodes: range) -> "Demonstrations":
        group = zarr.open_group(path, mode="r")
        bounds = np.asarray([0, *group[ENDS]])  # type: ignore[misc]
        start, end = bounds[episodes.start], bounds[episodes.stop]
        ends = bounds[episodes.start + 1 : episodes.stop + 1] - start
        return cls(*(np.asarray(group[name][start:end]) for name in ARRAYS), ends)  # type: ignore[index]

    def write(self, path: Path) -> None:
        arrays = (self.images, self.states, self.actions, self.ends)
        write_zarr(path, dict(zip((*ARRAYS, ENDS), arrays, strict=True)))


def put(pusht: Any, state: np.ndarray) -> None:
    """Put agent and block where `state` (5) says; `reset_to_state` turns the block about another point."""
    x, y, block_x, block_y, angle_rad = (float(value) for value in state)
    pusht.agent.position = (x, y)
    pusht.block.angle = angle_rad
    pusht.block.position = (block_x, block_y)
    for body in (pusht.agent, pusht.block):
        pusht.space.reindex_shapes_for_body(body)


@contextmanager
def starting_at(state: np.ndarray) -> Iterator[None]:
    """Start every environment `pusht` that is reset meanwhile in `state` (5), whatever its seed."""
    from gym_pusht.envs.pusht import PushTEnv

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PushTEnv, "_set_state", lambda pusht, _: put(pusht, state))
        yield


def convert(demonstrations: Demonstrations, folder: Path) -> Path:
    """Convert demonstrations to a LeRobotDataset in a new folder in `folder`, through the command line."""
    from lerobot_bomb.commands import main as cli

    demonstrations.write(folder / "source.zarr")
    flags = [f"--repo_id={REPO_ID}", f"--root={folder / 'pusht'}"]
    assert cli.main(["convert", "pusht-zarr", str(folder / "source.zarr"), *flags]) == 0
    return folder / "pusht"


def write_zarr(path: Path, arrays: dict[str, np.ndarray], zarr_format: int = 2) -> None:
    group = zarr.open_group(path, mode="w", zarr_format=zarr_format)  # type: ignore[arg-type]
    for name, values in arrays.items():
        chunks = (161, *values.shape[1:])
        compressor = Blosc("zstd", clevel=5, shuffle=2)
        options = {"compressors": compressor} if zarr_format == 2 else {}
        array = group.create_array(name, shape=values.shape, chunks=chunks, dtype=values.dtype, **options)
        array[:] = values
