"""LIBERO's demonstrations as a LeRobotDataset, as LeRobot's environment `libero` would show them."""

from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from lerobot_bomb.data.conversion import write_missing
from lerobot_bomb.data.facts import LIBERO_SOURCE
from lerobot_bomb.data.kept_blocks import Progress
from lerobot_bomb.data.libero_hdf5 import CONVENTIONS, LiberoHdf5
from lerobot_bomb.data.resumable import check_repo_id, grow
from lerobot_bomb.data.unfinished import check_folders, unfinished_folder
from lerobot_bomb.flags import one_of
from lerobot_bomb.libero.episode import LIBERO_FPS

if TYPE_CHECKING:
    from lerobot_bomb.data.blocks import DatasetLayout, RecordedEpisode

ROBOT_TYPE = "panda"
KEYS = ("observation.images.image", "observation.images.image2")
POSE = ("x", "y", "z", "rx", "ry", "rz")
STATE_NAMES = [*POSE, "finger_1", "finger_2"]
ACTION_NAMES = [*POSE, "gripper"]


@dataclass(frozen=True)
class LiberoConversion:
    """Parameters that determine a dataset converted from LIBERO's files."""

    kind: ClassVar[str] = "conversion"

    repo_id: str
    source: str  # its kind and its SHA-256
    suite: str  # LIBERO's name of it; empty: several, or not known
    images: bool = False  # instead of videos
    skip_noops: bool = False
    image_convention: str | None = None  # None: what each file says

    def __post_init__(self) -> None:
        check_repo_id(self.repo_id)

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


def convert_libero(
    path: Path,
    repo_id: str,
    root: Path,
    resume: bool = False,
    images: bool = False,
    skip_noops: bool = False,
    image_convention: str | None = None,
) -> Progress:
    """Convert the file or folder at `path` into `root`, which must not exist unless `resume` finds it begun.

    Raises:
        ValueError: the source is not LIBERO's or broken; `root` is in the way or holds something else.
        RuntimeError: h5py is not installed, or the disk is full.
    """
    if image_convention is not None:
        one_of("--image_convention", image_convention, tuple(CONVENTIONS))
    source = LiberoHdf5(path, image_convention, skip_noops)
    conversion = LiberoConversion(
        # by content: a moved folder can be resumed, a changed one not
        repo_id,
        f"{LIBERO_SOURCE} {source.sha256}",
        source.suite,
        images,
        skip_noops,
        image_convention,
    )
    check_folders(conversion, root, unfinished_folder(root, conversion.kind), resume)
    source.check()

    def layout() -> "DatasetLayout":
        return libero_layout(repo_id, source.image_shape, use_videos=not images)

    return grow(
        conversion,
        root,
        resume,
        write=lambda folder: write_missing(
            folder, layout(), source.num_episodes, partial(_recorded_episode, source)
        ),
        layout=layout,
    )


def libero_layout(repo_id: str, image_shape: tuple[int, int, int], use_videos: bool) -> "DatasetLayout":
    """Return the layout, with the keys under which a policy sees LeRobot's environment `libero`."""
    from lerobot_bomb.data.blocks import DatasetLayout

    camera = {
        "dtype": "video" if use_videos else "image",
        "shape": image_shape,
        "names": ["height", "width", "channels"],
    }
    features = {
        **dict.fromkeys(KEYS, camera),
        "observation.state": {"dtype": "float32", "shape": (len(STATE_NAMES),), "names": STATE_NAMES},
        "action": {"dtype": "float32", "shape": (len(ACTION_NAMES),), "names": ACTION_NAMES},
    }
    return DatasetLayout(repo_id, LIBERO_FPS, ROBOT_TYPE, features, use_videos)


def _recorded_episode(source: LiberoHdf5, index: int) -> "RecordedEpisode":
    """Return a demonstration's frames; columns tell its file and name."""
    from lerobot_bomb.data.blocks import RecordedEpisode

    demonstration, place = source.episode(index), source.sources[index]
    task = source.tasks[place.file]
    frames = (
        {**dict(zip(KEYS, images, strict=True)), "observation.state": state, "action": action, "task": task}
        for *images, state, action in zip(
            *demonstration.images, demonstration.states, demonstration.actions, strict=True
        )
    )
    return RecordedEpisode(frames, {"libero/file": place.file.name, "libero/demo": place.name})
