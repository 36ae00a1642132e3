"""``lerobot-bomb convert``: published demonstrations as a LeRobotDataset, frame for frame.

Like a recording, the dataset grows in a folder beside its final place (see ``data/resumable.py``).
"""

import argparse
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from lerobot_bomb.commands.arguments import add_new_dataset_arguments, path_flag, switch
from lerobot_bomb.data.conversion import write_missing
from lerobot_bomb.data.facts import LIBERO_SOURCE, PUSHT_SOURCE
from lerobot_bomb.data.kept_blocks import Progress
from lerobot_bomb.data.libero_conversion import convert_libero
from lerobot_bomb.data.pusht_zarr import BOARD_SIZE, IMAGE_SIZE, PushtZarr
from lerobot_bomb.data.resumable import (
    BLOCK_EPISODES,
    check_repo_id,
    default_root,
    grow,
    terminated_in_order,
)
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


def add_convert_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``lerobot-bomb convert``."""
    sources = parser.add_subparsers(dest="source", required=True, metavar="SOURCE")
    summary = "the PushT demonstrations of Diffusion Policy, pusht_cchi_v7_replay.zarr"
    _add_pusht_arguments(sources.add_parser(PUSHT_SOURCE, help=summary, description=f"Convert {summary}."))
    summary = "demonstrations of LIBERO, a file TASK_demo.hdf5 or a folder of them"
    _add_libero_arguments(sources.add_parser(LIBERO_SOURCE, help=summary, description=f"Convert {summary}."))


def _add_pusht_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("path", type=path_flag, help="the folder of the zarr")
    add_new_dataset_arguments(parser)
    add(
        "--task",
        default="",
        help="instruction of every frame (default: none, which is what lerobot-eval gives a policy on "
        "--env.type=pusht)",
    )
    add(
        "--copies",
        type=int,
        default=0,
        help="so many copies of each demonstration beside it: turned by any angle, half of them mirrored, "
        "shifted, the goal with the rest (default: 0)",
    )
    _add_resume(parser)


def _add_libero_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("path", type=path_flag, help="the file, or the folder of a suite's files")
    add_new_dataset_arguments(parser)
    add("--images", **switch(), help="store images (lossless) instead of videos")
    add(
        "--skip_noops",
        **switch(),
        help="leave out frames in which neither arm nor gripper is told to move (default: all are kept)",
    )
    add(
        "--image_convention",
        help="how the files hold images: opengl, upside down; opencv, upright; lerobot, turned already "
        "(default: what each file says, else opengl)",
    )
    _add_resume(parser)


def _add_resume(parser: argparse.ArgumentParser) -> None:
    summary = f"continue a conversion that was interrupted; its blocks of {BLOCK_EPISODES} episodes are kept"
    parser.add_argument("--resume", **switch(), help=summary)


def run_convert(args: argparse.Namespace) -> int:
    """Convert; prints where the dataset is."""
    check_repo_id(args.repo_id)
    root = args.root or default_root(args.repo_id)
    with terminated_in_order():
        if args.source == PUSHT_SOURCE:
            progress = convert_pusht(args.path, args.repo_id, root, args.task, args.resume, args.copies)
        else:
            options = (args.resume, args.images, args.skip_noops, args.image_convention)
            progress = convert_libero(args.path, args.repo_id, root, *options)
    print(f"{progress.num_episodes} episodes, {progress.num_frames} frames: {root}")
    return 0


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
    """The keys under which a policy sees LeRobot's environment `pusht`; images, since video is not exact."""
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
    """Return an episode: all demonstrations by number, then a copy of each, and so on."""
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
