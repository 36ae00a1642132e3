"""A dataset that grows in blocks beside its final place: a kill costs little and leaves no half dataset.

While it grows it is a folder, for a recording as follows:
    NAME.recording/recording.json   the parameters
    NAME.recording/block-00000/     a finished LeRobotDataset, and block.json: the progress up to its end
The merged dataset appears under its name at once, complete. What was lost or damaged in the meantime is
made again (see ``kept_blocks.py``).
"""

import errno
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from filelock import FileLock, Timeout
from tqdm import tqdm

from lerobot_bomb.data.kept_blocks import (
    UNFINISHED,
    Gap,
    Progress,
    block_path,
    damaged_blocks,
    find_gaps,
    finish_block,
    finished_blocks,
    reached,
    read_progress,
    remove,
    write_json,
)
from lerobot_bomb.files import read_json
from lerobot_bomb.flags import check_link

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

    from lerobot_bomb.data.blocks import DatasetLayout, RecordedEpisode

BLOCK_EPISODES = 20  # what a kill can cost: they are played or written again on --resume
LOCK_FILE = "lock"  # in the growing folder; a killed process releases it
LOCK_TIMEOUT_S = 0.5  # a process that is refused holds the lock for a moment
SEND_AGAIN_S = 0.05  # after a destructor has swallowed a signal
METADATA_FILE = Path("meta") / "bomb.json"  # in the dataset


class Parameters(Protocol):
    """Parameters that determine a dataset frame by frame."""

    kind: ClassVar[str]  # "recording": the noun of messages and the ending of the growing folder

    def to_dict(self) -> dict[str, Any]:
        """Return the parameters as JSON values, whose keys are flags."""
        ...


def grow(
    parameters: Parameters,
    root: Path,
    resume: bool,
    write: Callable[[Path], Progress],
    layout: Callable[[], "DatasetLayout"],
) -> Progress:
    """Let `write` fill a folder with the blocks that it lacks, then merge them into `root`.

    Raises:
        ValueError: the folder exists, is missing, cannot be written, is in use, or holds something else.
        RuntimeError: `write` gave up, the disk is full, or encoding failed.
    """
    folder = unfinished_folder(root, parameters.kind)
    try:
        check_folders(parameters, root, folder, resume)
        if root.exists():
            remove_folder(folder)  # left by a kill just after the last rename
            return _read_whole(root)
        lock = lock_folder(folder)
    except OSError as error:
        raise ValueError(f"--root={root} cannot be written: {error}") from error
    with lock:
        try:
            remove_unfinished(folder)  # left by a kill
            write_json(parameters_file(folder), {parameters.kind: parameters.to_dict()})
            progress = write(folder)
            _publish(parameters, layout(), progress, folder, root)
        except ValueError:  # a flag that only the environment can judge
            _keep_finished(folder)
            raise
        except (OSError, RuntimeError) as error:
            raise RuntimeError(f"--root={root}: {error}; {_keep_finished(folder)}") from error
        except (KeyboardInterrupt, SystemExit):
            tqdm.write(f"--root={root}: stopped; {_keep_finished(folder)}", file=sys.stderr)
            raise
        remove_folder(folder)
    return progress


def missing_blocks(folder: Path, num_episodes: int) -> list[Gap]:
    """Return what a dataset of so many episodes still lacks; delete damaged blocks and name them."""
    for block, damage in damaged_blocks(folder, num_episodes, BLOCK_EPISODES).items():
        tqdm.write(f"{block} {damage}; its episodes are made again", file=sys.stderr)
        remove([block])
    return find_gaps(folder, num_episodes, BLOCK_EPISODES)


def write_blocks(
    folder: Path,
    layout: "DatasetLayout",
    gap: Gap,
    next_episodes: Callable[[Progress, int], Iterator["RecordedEpisode"]],
) -> None:
    """Write the blocks of a gap; `next_episodes` yields so many and counts them in the progress."""
    from lerobot_bomb.data.blocks import write_block

    progress = gap.progress
    while gap.num_missing:
        block = block_path(folder, progress.num_episodes // BLOCK_EPISODES)
        unfinished = block.with_suffix(".tmp")
        size = min(BLOCK_EPISODES, gap.num_missing)
        progress.num_frames += write_block(layout, unfinished, next_episodes(progress, size))
        finish_block(unfinished, block, progress)


@contextmanager
def terminated_in_order() -> Iterator[None]:
    """Let SIGTERM end the command as Ctrl-C does, with the exit code that shells give it, 143.

    Python ignores what is raised in a destructor, so there either signal would be lost: it is sent again.
    """
    usual, usual_hook = signal.getsignal(signal.SIGTERM), sys.unraisablehook

    def send_again(ignored: "UnraisableHookArgs") -> None:
        number = {KeyboardInterrupt: signal.SIGINT, SystemExit: signal.SIGTERM}.get(ignored.exc_type)
        if number is None:
            usual_hook(ignored)
        else:  # at once, it would be raised in this function, and ignored too
            threading.Timer(SEND_AGAIN_S, os.kill, (os.getpid(), number)).start()

    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    sys.unraisablehook = send_again
    try:
        yield
    finally:
        sys.unraisablehook = usual_hook
        signal.signal(signal.SIGTERM, usual)


def check_repo_id(repo_id: str, flag: str = "--repo_id") -> None:
    """Raise a ValueError unless it is USER/NAME as the Hub takes them."""
    from huggingface_hub.errors import HFValidationError  # half a second, which no worker has
    from huggingface_hub.utils import validate_repo_id

    reason = "" if repo_id.count("/") == 1 else "one slash"
    try:
        validate_repo_id(repo_id)
    except HFValidationError as error:
        reason = reason or str(error).partition(f": '{repo_id}'")[0]
    if reason:
        raise ValueError(f"{flag}={repo_id!r} must have the form USER/NAME: {reason}")


def default_root(repo_id: str) -> Path:
    """Return where LeRobot looks for a dataset."""
    from lerobot.utils.constants import HF_LEROBOT_HOME  # imports torch: seconds

    return HF_LEROBOT_HOME / repo_id


def unfinished_folder(root: Path, kind: str = "recording") -> Path:
    """Return where a dataset grows until it is complete."""
    root = root.absolute()
    return root.with_name(f"{root.name}.{kind}")


def parameters_file(folder: Path) -> Path:
    """The file that says what grows in a folder: recording.json in NAME.recording."""
    return folder / f"{folder.suffix[1:]}.json"


def check_folders(parameters: Parameters, root: Path, folder: Path, resume: bool) -> None:
    """Refuse to overwrite anything, to resume nothing, and to mix two datasets.

    Raises:
        ValueError: names the flag and what is in the way.
        OSError: the folder cannot be written.
    """
    kind = parameters.kind
    check_link("--root", root)
    if not resume:
        _check_new(kind, root, folder)
    elif not root.exists() and not folder.exists():
        raise ValueError(
            f"--resume: there is no {kind} to go on with in --root={root}; begin it without --resume"
        )
    elif root.exists() and not (root / METADATA_FILE).exists():
        raise ValueError(f"--resume: --root={root} holds no {METADATA_FILE}, so it is no {kind}")
    else:
        path = root / METADATA_FILE if root.exists() else parameters_file(folder)
        _check_same(parameters, path, root if root.exists() else folder)


def _check_new(kind: str, root: Path, folder: Path) -> None:
    """Refuse what is in the way; to delete it is advised only where it is ours."""
    if root.exists():
        if not (root / METADATA_FILE).is_file():
            raise ValueError(f"--root={root} exists already; name a folder that does not exist yet")
        raise ValueError(
            f"--root={root} exists already, a finished {kind}: --resume checks that it is this one; for "
            "another name a folder that does not exist yet, or delete it"
        )
    if folder.exists():
        with lock_folder(folder):
            there = {path.name for path in folder.iterdir()} - {LOCK_FILE}
        path = parameters_file(folder)
        if there & {path.name, path.with_suffix(".tmp").name}:
            raise ValueError(f"{folder} holds an unfinished {kind}; go on with --resume or delete it")
        if there:
            raise ValueError(
                f"{folder} holds no {path.name}, so it is no {kind}, but it is where one would grow; give "
                "another --root"
            )


def _check_same(parameters: Parameters, path: Path, where: Path) -> None:
    """Refuse to go on `where` the parameters in a file are others."""
    kind = parameters.kind
    if not path.exists():
        if {other.name for other in path.parent.iterdir()} - {LOCK_FILE, path.with_suffix(".tmp").name}:
            raise ValueError(f"--resume: {path.parent} holds no {path.name}, so it is no {kind}")
        return  # killed before anything was written
    existing = read_json(path).get(kind)
    if existing is None:
        raise ValueError(f"--resume: {path} is not of a {kind}")
    # an earlier version wrote nothing of a flag that it had not: its default
    of_existing = {
        name: existing.get(name, getattr(type(parameters), name, None)) for name in parameters.to_dict()
    }
    differences = [
        f"{name}={value!r} (it has {of_existing[name]!r})"
        for name, value in parameters.to_dict().items()
        if value != of_existing[name]
    ]
    if differences:
        raise ValueError(
            f"--resume: the {kind} in {where} differs in {', '.join(differences)}; give the flags that "
            f"it was begun with, or another --root"
        )


def lock_folder(folder: Path) -> AbstractContextManager[object]:
    """Make the folder and keep others out until the returned context ends.

    Raises:
        ValueError: another process is at work there.
        OSError: the folder, or its final place beside it, cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    try:
        if not os.access(folder.parent, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(folder.parent))
        return FileLock(folder / LOCK_FILE).acquire(timeout=LOCK_TIMEOUT_S)
    except (Timeout, FileNotFoundError):  # it has finished and deleted the folder meanwhile
        raise ValueError(f"another process is at work in {folder}") from None
    except OSError:
        with suppress(OSError):
            folder.rmdir()  # unless it holds something
        raise


def remove_unfinished(folder: Path) -> None:
    """Leave the finished blocks, the parameters, the lock, and files that are not ours."""
    ours = [path for path in folder.iterdir() if UNFINISHED.fullmatch(path.name)]
    remove([*ours, parameters_file(folder).with_suffix(".tmp")])


def remove_folder(folder: Path) -> None:
    """Delete all that is ours in a folder, and the folder unless it then holds something."""
    if not folder.exists():
        return
    remove_unfinished(folder)
    remove([*finished_blocks(folder), parameters_file(folder), folder / LOCK_FILE])
    try:
        folder.rmdir()
    except OSError:
        left = ", ".join(sorted(path.name for path in folder.iterdir()))
        tqdm.write(f"{folder} stays: it holds {left}", file=sys.stderr)


def _publish(
    parameters: Parameters, layout: "DatasetLayout", progress: Progress, folder: Path, root: Path
) -> None:
    """Merge the blocks and give the complete dataset its name."""
    from lerobot_bomb.data.blocks import merge_blocks

    dataset = folder / "dataset"
    merge_blocks(layout, finished_blocks(folder), dataset)
    write_json(dataset / METADATA_FILE, {parameters.kind: parameters.to_dict(), **asdict(progress)})
    _read_whole(dataset)
    dataset.rename(root)


def _read_whole(dataset: Path) -> Progress:
    """Return the progress that was made, once all of a dataset's files are known to hold it.

    Raises:
        RuntimeError: names the file that is damaged, or what differs.
    """
    from lerobot_bomb.data.dataset_files import check_dataset, read_info

    progress = read_progress(dataset / METADATA_FILE)
    try:
        check_dataset(dataset)
        info = read_info(dataset)
    except ValueError as error:
        raise RuntimeError(str(error)) from error
    for name in ("episodes", "frames"):
        made, found = getattr(progress, f"num_{name}"), info[f"total_{name}"]
        if made != found:
            raise RuntimeError(f"{dataset} holds {found} {name}, but {made} were made")
    return progress


def _keep_finished(folder: Path) -> str:
    """Delete what is unfinished, which gives a full disk its space back; return what is kept."""
    remove_unfinished(folder)
    blocks = finished_blocks(folder)
    if not blocks:
        remove_folder(folder)
        return f"no block of {BLOCK_EPISODES} episodes was finished, so nothing is kept"
    num_episodes = reached(folder).num_episodes
    num_missing = sum(gap.num_missing for gap in find_gaps(folder, num_episodes, BLOCK_EPISODES))
    return f"{num_episodes - num_missing} episodes are kept in {folder}, go on with --resume"
