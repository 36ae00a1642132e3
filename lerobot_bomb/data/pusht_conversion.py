"""The PushT demonstrations of Diffusion Policy as a LeRobotDataset, frame for frame.

Like a recording, the dataset grows in a folder beside its final place (see ``data/resumable.py``).
"""

from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from lerobot_bomb.data.conversion import write_missing
from lerobot_bomb.data.facts import PUSHT_SOURCE
from lerobot_bomb.data.kept_blocks import Progress
from lerobot_bomb.data.pusht_zarr import BOARD_SIZE, IMAGE_SIZE, PushtZarr
from lerobot_bomb.data.resumable import check_repo_id, grow
from lerobot_bomb.data.rigid_copies import RigidMotion
from lerobot_bomb.data.unfinished import check_folders, unfinished_folder

if TYPE_CHECKING:
    from lerobot_bomb.data.blocks import DatasetLayout, RecordedEpisode

COPIES_SEED = 0
FPS = 10  # of the demonstrations and of LeRobot's environment `pusht`


@dataclass(frozen=True)
class Conversion:
    """Parameters that determine a converted dataset."""

    kind: ClassVar[str] = "conversion"

    repo_id: str
    task: str  # the instruction of every frame
    source: str  # its kind and its SHA-256
    copies: int = 0  # of each demonstration, as seen from elsewhere

    def __post_init__(self) -> None:
        check_repo_id(self.repo_id)
        if self.copies < 0:
            raise ValueError(f"--copies={self.copies} must not be negative")

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


def convert_pusht(
    path: Path, repo_id: str, root: Path, task: str = "", resume: bool = False, copies: int = 0
) -> Progress:
    """Convert the zarr at `path` into `root`, which must not exist unless `resume` finds the same one there.

    Raises:
        ValueError: the source is not PushT or broken; `root` is in the way or holds something else.
        RuntimeError: zarr is not installed, or the disk is full.
    """
    source = PushtZarr(path)
    conversion = Conversion(repo_id, task, f"{PUSHT_SOURCE} {source.sha256}", copies)
    check_folders(conversion, root, unfinished_folder(root, conversion.kind), resume)
    source.check()
    return grow(
        conversion,
        root,
        resume,
        write=lambda folder: write_missing(
            folder,
            _pusht_layout(repo_id),
            source.num_episodes * (1 + copies),
            partial(_pusht_episode, source, task),
        ),
        layout=lambda: _pusht_layout(repo_id),
    )


def _pusht_layout(repo_id: str) -> "DatasetLayout":
    """Return the layout, with the keys of LeRobot's environment `pusht`; images, since video is not exact."""
    from lerobot.utils.constants import ACTION, OBS_IMAGE, OBS_STATE

    from lerobot_bomb.data.blocks import DatasetLayout

    image_shape = (IMAGE_SIZE, IMAGE_SIZE, 3)
    features = {
        OBS_IMAGE: {"dtype": "image", "shape": image_shape, "names": ["height", "width", "channels"]},
        OBS_STATE: {"dtype": "float32", "shape": (2,), "names": ["agent_x", "agent_y"]},
        ACTION: {"dtype": "float32", "shape": (2,), "names": ["target_x", "target_y"]},
    }
    return DatasetLayout(repo_id, FPS, "pusht", features, use_videos=False)


def _pusht_episode(source: PushtZarr, task: str, index: int) -> "RecordedEpisode":
    """Return an episode by its number: all demonstrations, then a copy of each, and so on."""
    from lerobot.utils.constants import ACTION, OBS_IMAGE, OBS_STATE

    from lerobot_bomb.data.blocks import RecordedEpisode

    images, positions, actions = source.episode(index % source.num_episodes)
    if index >= source.num_episodes:
        motion = RigidMotion.drawn(np.random.default_rng((COPIES_SEED, index)), BOARD_SIZE)
        images = motion.images(images)
        positions, actions = motion.points(positions), motion.points(actions)
    frames = (
        {OBS_IMAGE: image, OBS_STATE: position, ACTION: action, "task": task}
        for image, position, action in zip(images, positions, actions, strict=True)
    )
    return RecordedEpisode(frames)
