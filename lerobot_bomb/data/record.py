"""The scripted expert's episodes as a LeRobotDataset.

A recording grows in a folder beside its final place (see ``resumable.py``). LeRobot and torch are
imported only after the flags have been checked and the workers are playing.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from lerobot_bomb.bomb.expert import expert_action
from lerobot_bomb.data.kept_blocks import Progress, reached
from lerobot_bomb.data.recording import Recording
from lerobot_bomb.data.resumable import grow, missing_blocks, write_blocks
from lerobot_bomb.data.rollout_pool import RelabelledRollouts, Rollout, RolloutPool, RolloutSettings
from lerobot_bomb.envs.rollout import Agent, Expert, make_env

if TYPE_CHECKING:
    from lerobot_bomb.data.blocks import DatasetLayout, RecordedEpisode

# the expert counts as broken when, after so many seeds, fewer succeed
MIN_TRIED = 20
MIN_SUCCESS_RATE = 0.1


@dataclass(frozen=True)
class Acting:
    """A policy that acts in place of the expert."""

    begin: Callable[[], None]  # before each episode
    agent: Agent


def record(
    recording: Recording,
    root: Path,
    num_workers: int = 1,
    resume: bool = False,
    expert: Expert = expert_action,
    acting: Acting | None = None,
) -> Progress:
    """Record into `root`, which must not exist unless `resume` finds the same recording there.

    The dataset depends on `recording` alone, not on the number of workers or on interruptions. With `acting`,
    which `recording.relabel` names, that policy acts and the expert says what it would have done.

    Raises:
        ValueError: the folder exists, is missing, cannot be written, is in use, or holds another recording.
        RuntimeError: the expert fails too often, the disk is full, or encoding failed.
    """
    return grow(
        recording,
        root,
        resume,
        write=lambda folder: _record_blocks(recording, folder, num_workers, expert, acting),
        layout=lambda: _layout(recording),
    )


def describe_failures(failures: list[dict[str, Any]]) -> str:
    """One line that counts the failed episodes, with their classes and seeds."""
    if not failures:
        return "No episode failed."
    seeds: dict[str, list[str]] = {}
    for failure in failures:
        seeds.setdefault(failure["failure"], []).append(str(failure["seed"]))
    classes = "; ".join(f"{len(of)} {name} (seeds {', '.join(of)})" for name, of in sorted(seeds.items()))
    return f"{len(failures)} failed and were left out: {classes}"


def _record_blocks(
    recording: Recording, folder: Path, num_workers: int, expert: Expert, acting: Acting | None
) -> Progress:
    """Write the blocks that are missing."""
    gaps = missing_blocks(folder, recording.episodes)
    if not gaps:
        return reached(folder)
    # MuJoCo's backend is chosen here, or its absence reported; the workers inherit the choice
    with recording.flag_names():
        for spec in recording.conditions:
            make_env(spec, recording.render_options).close()
    settings = RolloutSettings(
        recording.render_options,
        recording.noise,
        expert,
        recording.scenes if recording.static else 0,
        recording.pointing,
    )
    num_kept = recording.episodes - sum(gap.num_missing for gap in gaps)
    with tqdm(total=recording.episodes, initial=num_kept, unit="episode") as bar:
        for gap in gaps:
            specs = recording.specs(gap.progress.num_tried)
            with (
                RolloutPool(settings, specs, num_workers)
                if acting is None
                else RelabelledRollouts(settings, specs, acting.begin, acting.agent)
            ) as pool:
                layout = _layout(recording)  # takes seconds, in which the workers play
                write_blocks(folder, layout, gap, partial(_successes, pool, bar))
    return reached(folder)


def _successes(
    pool: Iterable[Rollout], bar: tqdm, progress: Progress, number: int
) -> "Iterator[RecordedEpisode]":
    """Yield so many successful rollouts; note the failed ones on the way."""
    from lerobot_bomb.data.rollout_dataset import rollout_episode

    for rollout in pool:
        if rollout.num_steps:
            progress.num_episodes += 1
            number -= 1
            yield rollout_episode(rollout)
            bar.update()
        else:
            progress.failures.append({"seed": rollout.result.spec.seed, "failure": rollout.result.failure})
            bar.set_postfix(failed=len(progress.failures))
            _check_success_rate(progress)
        if number == 0:
            return


def _check_success_rate(progress: Progress) -> None:
    if progress.num_tried >= MIN_TRIED and progress.num_episodes < MIN_SUCCESS_RATE * progress.num_tried:
        raise RuntimeError(
            f"only {progress.num_episodes} of {progress.num_tried} episodes succeeded, too few to go on; "
            f"a smaller --noise may help. {describe_failures(progress.failures)}"
        )


def _layout(recording: Recording) -> "DatasetLayout":
    from lerobot_bomb.data.rollout_dataset import rollout_layout

    return rollout_layout(recording)
