"""Conversions of published demonstrations: episodes by number, written as blocks."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from lerobot_bomb.data.kept_blocks import Progress, reached
from lerobot_bomb.data.resumable import missing_blocks, write_blocks

if TYPE_CHECKING:
    from lerobot_bomb.data.blocks import DatasetLayout, RecordedEpisode


def write_missing(
    folder: Path, layout: "DatasetLayout", num_episodes: int, episode: Callable[[int], "RecordedEpisode"]
) -> Progress:
    """Write the blocks that a dataset of so many episodes lacks; `episode` is called by number, in order."""
    gaps = missing_blocks(folder, num_episodes)
    num_kept = num_episodes - sum(gap.num_missing for gap in gaps)
    with tqdm(total=num_episodes, initial=num_kept, unit="episode") as bar:
        for gap in gaps:
            write_blocks(folder, layout, gap, partial(_next_episodes, episode, bar))
    return reached(folder)


def _next_episodes(
    episode: Callable[[int], "RecordedEpisode"], bar: tqdm, progress: Progress, number: int
) -> "Iterator[RecordedEpisode]":
    """Yield the next `number` episodes and count them."""
    for index in range(progress.num_episodes, progress.num_episodes + number):
        made = episode(index)
        progress.num_episodes += 1
        yield made
        bar.update()
