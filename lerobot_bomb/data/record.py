"""The scripted expert's episodes, in BOMB or LIBERO, as a LeRobotDataset.

A recording grows in a folder beside its final place (see ``resumable.py``).
"""

from functools import partial
from pathlib import Path

from lerobot_bomb.bomb.expert import expert_action
from lerobot_bomb.data.base_recording import BaseRecording
from lerobot_bomb.data.kept_blocks import Progress
from lerobot_bomb.data.parts import check_no_parts
from lerobot_bomb.data.recorded_blocks import (
    BehaviorPolicy,
    EpisodeSource,
    record_blocks,
)
from lerobot_bomb.data.resumable import grow
from lerobot_bomb.envs.rollout import Expert


def record(
    recording: BaseRecording,
    root: Path,
    num_workers: int = 1,
    resume: bool = False,
    expert: Expert = expert_action,
    behavior: BehaviorPolicy | None = None,
) -> Progress:
    """Record into `root`, which must not exist unless `resume` finds the same recording there.

    The dataset depends on `recording` alone, not on the number of workers or on interruptions. `behavior` is
    the policy that `recording.relabel` names: it acts, and the expert says what it would have done.

    Raises:
        ValueError: the folder exists, is missing, cannot be written, is in use, or holds another recording.
        RuntimeError: the expert fails too often, the disk is full, or encoding failed.
    """
    check_no_parts(root)
    source = EpisodeSource(num_workers, expert, behavior)
    return grow(
        recording,
        root,
        resume,
        write=partial(record_blocks, recording, source=source, most=recording.episodes),
        layout=recording.layout,
    )
