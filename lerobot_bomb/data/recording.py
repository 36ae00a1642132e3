"""A recording: what determines it, how far it got, and its files.

While a recording grows it is a folder beside its final place:
    NAME.recording/recording.json   the parameters
    NAME.recording/block-00000/     a finished LeRobotDataset, and block.json: the progress up to its end
"""

import errno
import itertools
import json
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from lerobot_bomb import __version__
from lerobot_bomb.perturbations import NONE
from lerobot_bomb.schema import (
    DEFAULT_FPS,
    DEFAULT_IMAGE_SIZE,
    PROTOCOL_VERSION,
    EpisodeSpec,
    RenderOptions,
)

MAX_NOISE = 1.0  # beyond it the noise exceeds the largest action

PARAMETERS_FILE = "recording.json"  # in the unfinished recording
LOCK_FILE = "lock"  # there too; a killed recorder releases it
LOCK_TIMEOUT_S = 0.5  # a recorder that is refused holds the lock for a moment
BLOCK_FILE = "block.json"  # in each block
METADATA_FILE = Path("meta") / "bomb.json"  # in the dataset


@dataclass(frozen=True)
class Recording:
    """What determines a recording frame by frame."""

    repo_id: str
    episodes: int
    seed: int = 0
    task: str = "place"
    robot: str = "scara"
    control_mode: str = "relative"
    fps: int = DEFAULT_FPS
    image_size: int = DEFAULT_IMAGE_SIZE
    split: str = "all"
    # numbered tasks, each played from every seed; empty = target and colour are drawn per episode
    task_ids: tuple[int, ...] = ()
    perturbations: tuple[str, ...] = (NONE,)  # conditions, each played from every seed, with every task
    images: bool = False
    depth: bool = False
    noise: float = 0.0
    protocol_version: str = PROTOCOL_VERSION
    package_version: str = __version__

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[\w.-]+/[\w.-]+", self.repo_id):
            raise ValueError(f"--repo_id={self.repo_id!r} must have the form USER/NAME")
        if self.episodes < 1:
            raise ValueError(f"--episodes={self.episodes} must be at least 1")
        if len(set(self.task_ids)) < len(self.task_ids):
            raise ValueError(f"--task_ids={list(self.task_ids)} has a task twice")
        if not self.perturbations:
            raise ValueError('--perturbations=[] names no condition; leave it out or give ["none"]')
        if not 0 <= self.noise <= MAX_NOISE:
            raise ValueError(
                f"--noise={self.noise} must lie in 0..{MAX_NOISE:g}; "
                "it is a standard deviation in units of the largest step, 40 mm"
            )
        with recorder_flags():
            conditions, _ = self.conditions, self.render_options  # they check the remaining flags
        if len(set(conditions)) < len(conditions):
            raise ValueError(f"--perturbations={','.join(self.perturbations)} has a condition twice")

    @property
    def spec(self) -> EpisodeSpec:
        """What all episodes have in common, with the first seed."""
        return EpisodeSpec(
            seed=self.seed,
            suite=self.task,
            robot=self.robot,
            split=self.split,
            control_mode=self.control_mode,
            fps=self.fps,
        )

    def to_dict(self) -> dict[str, Any]:
        """What its JSON reads back as."""
        return json.loads(json.dumps(asdict(self)))

    @property
    def conditions(self) -> list[EpisodeSpec]:
        """The specs that every seed is played with, with the first seed."""
        tasks = [self.spec.for_task(task_id) for task_id in self.task_ids] or [self.spec]
        return [replace(task, perturbations=text) for task in tasks for text in self.perturbations]

    def specs(self, num_tried: int) -> Iterator[EpisodeSpec]:
        """The episodes to try after the first `num_tried`: seeds count up, each with all conditions."""
        for tried in itertools.count(num_tried):
            seeds_done, condition = divmod(tried, len(self.conditions))
            yield replace(self.conditions[condition], seed=self.seed + seeds_done)

    @property
    def render_options(self) -> RenderOptions:
        return RenderOptions(image_size=self.image_size, depth=self.depth)


@contextmanager
def recorder_flags() -> Iterator[None]:
    """Name flags in error messages as the recorder does; LeRobot's commands call them --env.*."""
    try:
        yield
    except ValueError as error:
        message = str(error).replace("--env.target=", "the target ").replace("--env.", "--")
        raise ValueError(message) from None


@dataclass
class Progress:
    """What has been recorded."""

    num_episodes: int = 0
    num_frames: int = 0
    failures: list[dict[str, Any]] = field(default_factory=list)  # [{"seed": ..., "failure": ...}]

    @property
    def num_tried(self) -> int:
        return self.num_episodes + len(self.failures)


def unfinished_folder(root: Path) -> Path:
    """Where a recording grows until it is complete."""
    root = root.absolute()
    return root.with_name(f"{root.name}.recording")


def check_folders(recording: Recording, root: Path, folder: Path, resume: bool) -> None:
    """Refuse to overwrite anything, to resume nothing, and to mix two recordings.

    Raises:
        ValueError: names the flag and what is in the way.
        OSError: the folder cannot be written.
    """
    if not resume:
        if root.exists():
            raise ValueError(f"--root={root} exists already; name a folder that does not exist yet")
        if folder.exists():
            with lock_folder(folder):
                if {path.name for path in folder.iterdir()} - {LOCK_FILE}:
                    raise ValueError(
                        f"{folder} holds an unfinished recording; go on with --resume or delete it"
                    )
    elif not root.exists() and not folder.exists():
        raise ValueError(f"--resume: there is no recording to go on with in --root={root}")
    elif root.exists() and not (root / METADATA_FILE).exists():
        raise ValueError(f"--resume: --root={root} holds no {METADATA_FILE}, so it is no recording")
    else:
        _check_same_recording(recording, root / METADATA_FILE if root.exists() else folder / PARAMETERS_FILE)


def _check_same_recording(recording: Recording, path: Path) -> None:
    if not path.exists():
        if {other.name for other in path.parent.iterdir()} - {LOCK_FILE, path.with_suffix(".tmp").name}:
            raise ValueError(f"--resume: {path.parent} holds no {path.name}, so it is no recording")
        return  # killed before anything was recorded
    existing = json.loads(path.read_text())["recording"]
    differences = [
        f"--{name}={value} (it has {existing.get(name)})"
        for name, value in recording.to_dict().items()
        if value != existing.get(name)
    ]
    if differences:
        raise ValueError(f"--resume: the recording in {path.parent} differs in {', '.join(differences)}")


def lock_folder(folder: Path) -> AbstractContextManager[object]:
    """Make the folder and keep other recorders out until the returned context ends.

    Raises:
        ValueError: another recorder is at work there.
        OSError: the folder, or its final place beside it, cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    try:
        if not os.access(folder.parent, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(folder.parent))
        return FileLock(folder / LOCK_FILE).acquire(timeout=LOCK_TIMEOUT_S)
    except (Timeout, FileNotFoundError):  # it has finished and deleted the folder meanwhile
        raise ValueError(f"another process is recording in {folder}") from None
    except OSError:
        with suppress(OSError):
            folder.rmdir()  # unless it holds something
        raise


def remove_unfinished(folder: Path) -> None:
    """Leave only finished blocks, the parameters and the lock."""
    kept = {folder / LOCK_FILE, folder / PARAMETERS_FILE, *finished_blocks(folder)}
    for path in set(folder.iterdir()) - kept:
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def finished_blocks(folder: Path) -> list[Path]:
    """Folders of the blocks that a resumed recording keeps, in order."""
    return sorted(path for path in folder.glob("block-*") if path.suffix != ".tmp")


def read_progress(path: Path) -> Progress:
    """Progress from a file of either kind."""
    values = json.loads(path.read_text())
    return Progress(**{f.name: values[f.name] for f in fields(Progress)})


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Write a file that is complete whenever it exists."""
    unfinished = path.with_suffix(".tmp")
    unfinished.write_text(json.dumps(values, indent=1))
    unfinished.replace(path)
