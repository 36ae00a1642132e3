"""Conversions of published demonstrations: episodes by number, written as blocks."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from lerobot_bomb.data.kept_blocks import Progress
from lerobot_bomb.data.resumable import add_block, block_episodes, missing_blocks, num_blocks

if TYPE_CHECKING:
    from lerobot_bomb.data.blocks import DatasetLayout, RecordedEpisode


def write_missing(
    folder: Path, layout: "DatasetLayout", num_episodes: int, episode: Callable[[int], "RecordedEpisode"]
) -> None:
    """Write the missing blocks of a dataset; `episode` is called by number, in order."""
    numbers = [number for gap in missing_blocks(folder, range(num_blocks(num_episodes))) for number in gap]
    missing = [[index for index in block_episodes(number) if index < num_episodes] for number in numbers]
    with tqdm(total=num_episodes, initial=num_episodes - sum(map(len, missing)), unit="episode") as bar:

        def episodes(indices: list[int], progress: Progress) -> "Iterator[RecordedEpisode]":
            for index in indices:
                made = episode(index)
                progress.num_episodes += 1
                yield made
                bar.update()

        for number, indices in zip(numbers, missing, strict=True):
            add_block(folder, layout, number, partial(episodes, indices))
