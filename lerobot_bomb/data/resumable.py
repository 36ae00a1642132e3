"""A dataset that grows in blocks beside its final place: a kill costs little and leaves no half dataset.

While a recording grows, it is a folder:

    NAME.recording/recording.json   the parameters
    NAME.recording/block-00000/     a finished LeRobotDataset, and block.json: what it holds

The merged dataset appears under its name at once, complete. Lost or damaged blocks are made again (see
``kept_blocks.py``).
"""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from lerobot_bomb.data.kept_blocks import (
    BLOCK_FILE,
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
from lerobot_bomb.data.unfinished import (
    METADATA_FILE,
    Parameters,
    check_folders,
    lock_folder,
    parameters_file,
    remove_folder,
    remove_unfinished,
    unfinished_folder,
)

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

    from lerobot_bomb.data.blocks import DatasetLayout, RecordedEpisode

BLOCK_EPISODES = 20  # what a kill can cost: they are run or written again on --resume
SEND_AGAIN_S = 0.05  # after a destructor has swallowed a signal


def grow(
    parameters: Parameters,
    root: Path,
    resume: bool,
    write: Callable[[Path], None],
    layout: Callable[[], "DatasetLayout"],
    parts: Sequence[Path] = (),
) -> Progress:
    """Let `write` add the missing blocks to a folder, then merge all into `root`.

    Args:
        parameters: what determines the dataset.
        root: where it appears.
        resume: continue with what is there, instead of refusing it.
        write: makes the blocks.
        layout: of the dataset.
        parts: folders that hold its first blocks.

    Raises:
        ValueError: the folder exists, is missing, cannot be written, is in use, or holds something else.
        RuntimeError: `write` gave up, the disk is full, or encoding failed.
    """
    folder = unfinished_folder(root, parameters.kind)
    try:
        check_folders(parameters, root, folder, resume)
    except OSError as error:
        raise ValueError(f"--root={root} cannot be written: {error}") from error
    if root.exists():
        remove_folder(folder)  # left by a kill just after the last rename
        return _read_whole(root)
    with growing(parameters, root, folder, parts):
        write(folder)
        blocks = [block for block in finished_blocks(*parts, folder) if _num_episodes(block)]
        progress = reached(*parts, folder)
        _publish(parameters, layout(), progress, blocks, folder, root)
    return progress


@contextmanager
def growing(parameters: Parameters, root: Path, folder: Path, parts: Sequence[Path] = ()) -> Iterator[None]:
    """Lock a folder while its blocks are made; finished blocks are kept until `root` is there.

    Raises:
        ValueError: the folder cannot be written, or is in use.
        RuntimeError: an error occurred in the meantime; the message says what is kept.
    """
    try:
        lock = lock_folder(folder)
    except OSError as error:
        raise ValueError(f"--root={root} cannot be written: {error}") from error
    with lock:
        try:
            remove_unfinished(folder)  # left by a kill
            write_json(parameters_file(folder), {parameters.kind: parameters.to_dict()})
            yield
        except ValueError:  # a flag that only the environment can judge
            _keep_finished(folder, parts)
            raise
        except (OSError, RuntimeError) as error:
            raise RuntimeError(f"--root={root}: {error}; {_keep_finished(folder, parts)}") from error
        except (KeyboardInterrupt, SystemExit):
            tqdm.write(f"--root={root}: stopped; {_keep_finished(folder, parts)}", file=sys.stderr)
            raise
        if root.exists():
            remove_folder(folder)


def block_episodes(number: int) -> range:
    """Return the numbers of a block's episodes; in a recording, of those that it tries."""
    return range(number * BLOCK_EPISODES, (number + 1) * BLOCK_EPISODES)


def num_blocks(num_episodes: int) -> int:
    """Return the number of blocks of this many episodes; the last one may be short."""
    return -(-num_episodes // BLOCK_EPISODES)


def missing_blocks(folder: Path, numbers: range) -> list[range]:
    """Return the numbers of blocks that a folder lacks; damaged blocks are deleted and named."""
    for block, damage in damaged_blocks(folder, numbers).items():
        tqdm.write(f"{block} {damage}; its episodes are made again", file=sys.stderr)
        remove([block])
    return find_gaps(folder, numbers)


def add_block(
    folder: Path,
    layout: "DatasetLayout",
    number: int,
    episodes: Callable[[Progress], Iterator["RecordedEpisode"]],
) -> Progress:
    """Make a block of episodes and return its counts, which the episodes fill in."""
    from lerobot_bomb.data.blocks import write_block

    block, progress = block_path(folder, number), Progress()
    unfinished = block.with_suffix(".tmp")
    progress.num_frames = write_block(layout, unfinished, episodes(progress))
    finish_block(unfinished, block, progress)
    return progress


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
    """Raise a ValueError unless a name is USER/NAME as the Hub takes them."""
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


def _publish(
    parameters: Parameters,
    layout: "DatasetLayout",
    progress: Progress,
    blocks: list[Path],
    folder: Path,
    root: Path,
) -> None:
    """Merge the blocks and give the complete dataset its name."""
    from lerobot_bomb.data.blocks import merge_blocks

    dataset = folder / "dataset"
    merge_blocks(layout, blocks, dataset)
    write_json(dataset / METADATA_FILE, {parameters.kind: parameters.to_dict(), **asdict(progress)})
    _read_whole(dataset)
    dataset.rename(root)


def _num_episodes(block: Path) -> int:
    return read_progress(block / BLOCK_FILE).num_episodes


def _read_whole(dataset: Path) -> Progress:
    """Check that all files of a dataset are whole and hold its progress; return that.

    Raises:
        RuntimeError: names the file that is damaged, or what differs.
    """
    from lerobot_bomb.data.dataset_files import check_dataset

    try:
        check_dataset(dataset)
        check_counts(dataset)
    except ValueError as error:
        raise RuntimeError(str(error)) from error
    return read_progress(dataset / METADATA_FILE)


def check_counts(dataset: Path) -> None:
    """Raise a ValueError if a dataset holds another number of episodes or frames than was made."""
    from lerobot_bomb.data.dataset_files import read_info

    progress, info = read_progress(dataset / METADATA_FILE), read_info(dataset)
    for name in ("episodes", "frames"):
        made, found = getattr(progress, f"num_{name}"), info[f"total_{name}"]
        if made != found:
            raise ValueError(
                f"{dataset} holds {found} {name}, but {METADATA_FILE} says that {made} were made"
            )


def _keep_finished(folder: Path, parts: Sequence[Path]) -> str:
    """Delete everything unfinished, which frees disk space; describe the rest."""
    remove_unfinished(folder)
    blocks = finished_blocks(folder)
    if not blocks:
        remove_folder(folder)
    if parts:
        return "all parts stay, and the same command resumes"
    if not blocks:
        return f"no block of {BLOCK_EPISODES} episodes was finished, so nothing is kept"
    return f"{reached(folder).num_episodes} episodes are kept in {folder}, continue with --resume"
