"""Blocks of a recording, run and written.

LeRobot and torch are imported only after the flags have been checked and the workers are running.
"""

import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from lerobot_bomb.bomb.expert import expert_action
from lerobot_bomb.data.base_recording import BaseRecording
from lerobot_bomb.data.kept_blocks import Progress, episodes_before, reached
from lerobot_bomb.data.resumable import add_block, block_episodes, missing_blocks
from lerobot_bomb.data.rollout_pool import AnyRollout, RolloutPool, RolloutsHere
from lerobot_bomb.envs.rollout import Agent, Expert

if TYPE_CHECKING:
    from lerobot_bomb.data.blocks import RecordedEpisode

ANY_NUMBER = sys.maxsize
# the expert counts as broken if, after so many episodes, fewer succeed
MIN_TRIED = 20
MIN_SUCCESS_RATE = 0.1


@dataclass(frozen=True)
class BehaviorPolicy:
    """A policy that acts in place of the expert."""

    begin: Callable[[int], None]  # before each episode, whose number it takes
    agent: Agent


@dataclass(frozen=True)
class EpisodeSource:
    """Source of a recording's episodes: workers, expert, and the policy that acts instead of it."""

    num_workers: int = 1
    expert: Expert = expert_action
    behavior: BehaviorPolicy | None = None  # the expert says what it would have done

    def rollouts(self, recording: BaseRecording, num_tried: int) -> RolloutPool | RolloutsHere:
        """Return the episodes of a recording after the first `num_tried`."""
        settings, specs = recording.rollouts(self.expert), recording.specs(num_tried)
        if self.behavior is None:
            return RolloutPool(settings, specs, self.num_workers)
        return RolloutsHere(settings, specs, num_tried, self.behavior.begin, self.behavior.agent)


def record_blocks(
    recording: BaseRecording,
    folder: Path,
    source: EpisodeSource,
    numbers: range = range(ANY_NUMBER),
    most: int = ANY_NUMBER,
) -> None:
    """Make the missing blocks among `numbers`, until the folder holds `most` episodes.

    A block tries episodes of its own and holds those that succeed, whoever makes it.
    """
    gaps = [gap for gap in missing_blocks(folder, numbers) if episodes_before(folder, gap.start) < most]
    if not gaps:
        return
    # MuJoCo's backend is chosen here, or its absence reported; the workers inherit the choice
    settings = recording.rollouts(source.expert)
    with recording.flag_names():
        for spec in recording.conditions:
            settings.make_env(spec).close()
    run = reached(folder)
    total = min(most, block_episodes(numbers.stop).start - block_episodes(numbers.start).start)
    with tqdm(total=total, initial=run.num_episodes, unit="episode") as bar:
        for gap in gaps:
            _fill(recording, folder, source, gap, most, partial(_successes, run, bar))


def _fill(
    recording: BaseRecording,
    folder: Path,
    source: EpisodeSource,
    gap: range,
    most: int,
    successes: "Callable[[Iterable[AnyRollout], int, Progress], Iterator[RecordedEpisode]]",
) -> None:
    """Make the blocks of a gap, until the folder holds `most` episodes."""
    left = most - episodes_before(folder, gap.start)
    if left == 0:
        return
    with source.rollouts(recording, block_episodes(gap.start).start) as pool:
        layout = recording.layout()  # takes seconds, in which the workers run
        for number in gap:
            made = add_block(folder, layout, number, partial(successes, pool, left))
            left -= made.num_episodes
            if left == 0:
                return


def _successes(
    run: Progress, bar: tqdm, pool: Iterable[AnyRollout], most: int, progress: Progress
) -> "Iterator[RecordedEpisode]":
    """Yield a block's successful rollouts, at most `most`; count the failed ones on the way."""
    for rollout in islice(pool, len(block_episodes(0))):
        if rollout.num_steps:
            progress.num_episodes += 1
            run.num_episodes += 1
            yield rollout.episode()
            bar.update()
        else:
            failure = {"seed": rollout.result.spec.seed, "failure": rollout.result.failure}
            progress.failures.append(failure)
            run.failures.append(failure)
            bar.set_postfix(failed=len(run.failures))
            _check_success_rate(run)
        if progress.num_episodes == most:
            return


def _check_success_rate(progress: Progress) -> None:
    if progress.num_tried >= MIN_TRIED and progress.num_episodes < MIN_SUCCESS_RATE * progress.num_tried:
        raise RuntimeError(
            f"only {progress.num_episodes} of {progress.num_tried} episodes succeeded, too few to go on; "
            f"a smaller --noise may help. {describe_failures(progress.failures)}"
        )


def describe_failures(failures: list[dict[str, Any]]) -> str:
    """Count the failed episodes in one line, with their classes and seeds."""
    if not failures:
        return "No episode was left out."
    seeds: dict[str, list[str]] = {}
    for failure in failures:
        seeds.setdefault(failure["failure"], []).append(str(failure["seed"]))
    classes = "; ".join(
        f"{len(numbers)} {name} (seeds {', '.join(numbers)})" for name, numbers in sorted(seeds.items())
    )
    return f"{len(failures)} failed and were left out: {classes}"
