"""The folder in which a dataset grows: its place, its owner, and the files that we may delete."""

import errno
import os
import sys
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any, ClassVar, Protocol

from filelock import FileLock, Timeout
from tqdm import tqdm

from lerobot_bomb.data.kept_blocks import UNFINISHED, finished_blocks, remove
from lerobot_bomb.files import read_json
from lerobot_bomb.flags import check_link

LOCK_FILE = "lock"  # in the growing folder; a killed process releases it
LOCK_TIMEOUT_S = 0.5  # a process that is refused holds the lock for a moment
METADATA_FILE = Path("meta") / "bomb.json"  # in the dataset


class Parameters(Protocol):
    """Parameters that determine a dataset frame by frame."""

    kind: ClassVar[str]  # "recording": the noun of messages and the ending of the growing folder

    def to_dict(self) -> dict[str, Any]:
        """Return the values as JSON reads them back; the keys are flags."""
        ...


def unfinished_folder(root: Path, kind: str = "recording") -> Path:
    """Return the folder where a dataset grows until it is complete."""
    root = root.absolute()
    return root.with_name(f"{root.name}.{kind}")


def parts_folder(root: Path) -> Path:
    """Return the folder where the parts of a recording lie until they are joined."""
    return unfinished_folder(root, "parts")


def parameters_file(folder: Path) -> Path:
    """Return the file with the parameters of a growing dataset: recording.json in NAME.recording."""
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
            f"--resume: there is no {kind} to resume in --root={root}; begin it without --resume"
        )
    elif root.exists() and not (root / METADATA_FILE).exists():
        raise ValueError(f"--resume: --root={root} holds no {METADATA_FILE}, so it is no {kind}")
    else:
        path = root / METADATA_FILE if root.exists() else parameters_file(folder)
        check_same("--resume", parameters, path, root if root.exists() else folder)


def _check_new(kind: str, root: Path, folder: Path) -> None:
    """Refuse what is in the way; advise to delete it only if it is ours."""
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
            raise ValueError(f"{folder} holds an unfinished {kind}; continue with --resume or delete it")
        if there:
            raise ValueError(
                f"{folder} holds no {path.name}, so it is no {kind}, but it is where one would grow; give "
                "another --root"
            )


def check_same(flag: str, parameters: Parameters, path: Path, where: Path) -> None:
    """Raise a ValueError that names a flag if the parameters in a file differ."""
    kind = parameters.kind
    if not path.exists():
        if {other.name for other in path.parent.iterdir()} - {LOCK_FILE, path.with_suffix(".tmp").name}:
            raise ValueError(f"{flag}: {path.parent} holds no {path.name}, so it is no {kind}")
        return  # killed before anything was written
    existing = read_json(path).get(kind)
    if existing is None:
        raise ValueError(f"{flag}: {path} is not of a {kind}")
    # a flag that an earlier version lacked has its default
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
            f"{flag}: the {kind} in {where} differs in {', '.join(differences)}; give the flags that "
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
    """Delete unfinished files; leave finished blocks, parameters, the lock, and files that are not ours."""
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
