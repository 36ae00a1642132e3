"""LIBERO's demonstrations as they are published: a file TASK_demo.hdf5 of each task, or a folder of them.

Three things differ from a file's content (see `libero_checks.py`), to match what `lerobot-eval
--env.type=libero` shows a policy: images are turned, an action stands beside the observation before it, and
the task is named as hf-libero names it, after the task's file.
"""

import hashlib
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from lerobot_bomb.data.libero_checks import CAMERAS, STATE, Timing, are_after, checked_values
from lerobot_bomb.libero.assets import SUITES

DATASETS_REPO = "yifengzhu-hf/LIBERO-datasets"
# how a file's images are turned to those of LeRobot: over rows, columns
CONVENTIONS = {"opengl": (-1, -1), "opencv": (1, -1), "lerobot": (1, 1)}
SUFFIX = "_demo"
NOOP_MAX = 1e-4  # norm of the six dims that move the arm, as OpenVLA filters LIBERO


@dataclass(frozen=True)
class Demonstration:
    """An episode as LeRobot's environment `libero` would show it to a policy."""

    images: tuple[np.ndarray, ...]  # of each camera, (T, H, W, 3) uint8
    states: np.ndarray  # (T, 8) float32: metres, axis-angle, metres of both fingers
    actions: np.ndarray  # (T, 7) float32 in -1..1; the gripper's -1 opens


@dataclass(frozen=True)
class _Source:
    """A demonstration's place."""

    file: Path
    name: str  # demo_0


class LiberoHdf5:
    """The demonstrations of a file or a folder; `check` must have passed before they are read.

    Args:
        path: a file TASK_demo.hdf5, or a folder of such files.
        convention: one of `CONVENTIONS`, in which images were stored; None: what each file says, else opengl.
        skip_noops: leave frames out in which neither arm nor gripper is told to move.

    Raises:
        ValueError: there is no such file, or it is none of LIBERO's; names what and where.
    """

    def __init__(self, path: Path, convention: str | None = None, skip_noops: bool = False) -> None:
        self.path = path
        self.skip_noops = skip_noops
        self.files = _find_files(path)
        self.sources: list[_Source] = []
        self.tasks: dict[Path, str] = {}
        self._suites: set[str] = set()
        self._conventions: dict[Path, str] = {}
        self._is_after: dict[Path, bool] = {}  # whether observations were taken after their row's action
        for file in self.files:
            with _opened(file) as data:
                self._conventions[file] = convention or _convention(file, data)
                task_file = _task_file(file, data)
                self.tasks[file] = instruction(task_file.stem)
                self._suites.add(task_file.parent.name)
                self.sources += [_Source(file, name) for name in _demo_names(file, data)]

    @property
    def num_episodes(self) -> int:
        return len(self.sources)

    @property
    def suite(self) -> str:
        """Name of the suite of all files; empty if there are several, or it is unknown."""
        suite, *others = self._suites
        return suite if not others and suite in SUITES else ""

    @cached_property
    def image_shape(self) -> tuple[int, int, int]:
        """(H, W, 3) of the first image, which all must have."""
        with _opened(self.sources[0].file) as data:
            return data[self.sources[0].name]["obs"][CAMERAS[0]].shape[1:]

    @cached_property
    def sha256(self) -> str:
        """SHA-256 of all files."""
        digest = hashlib.sha256()
        for file in tqdm(self.files, desc="reading", unit="file"):
            with file.open("rb") as opened:
                digest.update(f"{file.name} {hashlib.file_digest(opened, 'sha256').hexdigest()}\n".encode())
        return digest.hexdigest()

    def check(self) -> None:
        """Read and check everything but the images once.

        Raises:
            ValueError: names the demonstration that lacks something or holds what LIBERO's cannot.
        """
        for file in tqdm(self.files, desc="checking", unit="file"):
            self._is_after[file] = self._check_file(file)

    def episode(self, index: int) -> Demonstration:
        """Return a demonstration; it loses a frame if observations were stored after their actions."""
        source = self.sources[index]
        rows, columns = CONVENTIONS[self._conventions[source.file]]
        with _opened(source.file) as data:
            demo = data[source.name]
            observed, acted = _pairs(len(demo["actions"]), self._is_after[source.file])
            actions = demo["actions"][acted].astype(np.float32)
            states = np.concatenate([demo["obs"][name][observed] for name in STATE], axis=1)
            images = [demo["obs"][name][observed][:, ::rows, ::columns] for name in CAMERAS]
        kept = ~noops(actions) if self.skip_noops else np.ones(len(actions), dtype=bool)
        return Demonstration(
            tuple(np.ascontiguousarray(image[kept]) for image in images),
            states[kept].astype(np.float32),
            actions[kept],
        )

    def _check_file(self, file: Path) -> bool:
        """Check all demonstrations of a file; return True if observations were taken after their actions."""
        with _opened(file) as data:
            timings = []
            for name in [source.name for source in self.sources if source.file == file]:
                values = checked_values(f"{file}: data/{name}", data[name], self.image_shape)
                if self.skip_noops and noops(values["actions"][1:]).all():
                    raise ValueError(f"{file}: data/{name} would have no frame left; leave --skip_noops out")
                timings.append(Timing.of(values))
        return are_after(file, timings)


def instruction(task: str) -> str:
    """Return a task's sentence from the name of its file, as LeRobot's environment gives it.

    It is not the file's own `language_instruction`, which has `Pick the akita black bowl` where this has
    `pick up the black bowl`.
    """
    return re.sub(r"^[A-Z].*?SCENE\d+_", "", task).replace("_", " ")


def noops(actions: np.ndarray) -> np.ndarray:
    """Actions (T, 7) -> (T,) bool: neither arm nor gripper gets a new command."""
    still = np.linalg.norm(actions[:, :-1], axis=1) < NOOP_MAX
    found = np.zeros(len(actions), dtype=bool)
    told = None
    for step, gripper in enumerate(actions[:, -1]):
        found[step] = still[step] and told in (None, gripper)
        told = told if found[step] else gripper
    return found


def _pairs(num_actions: int, is_after: bool) -> tuple[slice, slice]:
    """Return the rows of observations, and those of the actions that were chosen on them."""
    return (slice(0, num_actions - 1), slice(1, num_actions)) if is_after else (slice(None), slice(None))


def _find_files(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise ValueError(
            f"{path} does not exist; name a file TASK{SUFFIX}.hdf5 of LIBERO, or a folder of them"
        )
    files = sorted(path.glob("*.hdf5"))
    if not files:
        below = sorted({file.parent.name for file in path.glob("*/*.hdf5")})
        hint = f"; name one of its folders: {', '.join(below)}" if below else ""
        raise ValueError(f"{path} holds no file TASK{SUFFIX}.hdf5{hint}")
    return files


@contextmanager
def _opened(file: Path) -> Iterator[Any]:
    """Yield the group `data` of a file."""
    h5py = _import_h5py()
    try:
        opened = h5py.File(file, "r")
    except OSError as error:  # h5py's own, also for what is no HDF5
        raise ValueError(f"{file} cannot be read as HDF5, or is cut off: {error}; get it again") from error
    with opened:
        if "data" not in opened:
            raise ValueError(f"{file} has no group data, so it is not of LIBERO")
        yield opened["data"]


def _import_h5py() -> Any:
    try:
        import h5py
    except ImportError as error:
        raise RuntimeError(f"{error}: run pip install h5py") from error
    return h5py


def _demo_names(file: Path, data: Any) -> list[str]:
    """Return the names of the demonstrations, in the order of their numbers."""
    names = [name for name in data if re.fullmatch(r"demo_\d+", name)]
    if not names:
        raise ValueError(f"{file}: data holds no demo_0, demo_1, ..., so it is not of LIBERO")
    first = data[min(names)]
    if "obs" not in first or not all(camera in first["obs"] for camera in CAMERAS):
        raise ValueError(f"{file} holds no images (obs/{CAMERAS[0]}, obs/{CAMERAS[1]}): {_way_out(data)}")
    return sorted(names, key=lambda name: int(name.removeprefix("demo_")))


def _way_out(data: Any) -> str:
    """Describe the way out for a file that holds states and actions only."""
    if "problem_info" in data.attrs:
        return "LIBERO's scripts/create_dataset.py plays such a recording and writes a file with images"
    env = data.attrs.get("env", "unknown")
    return (
        f"it is a demonstration of robosuite's environment {env}, which LeRobot does not have, and not of "
        f"LIBERO; LIBERO's are on the Hub: hf download {DATASETS_REPO} --repo-type=dataset --local-dir=LIBERO"
    )


def _convention(file: Path, data: Any) -> str:
    convention = data.attrs.get("macros_image_convention", "opengl")
    if convention not in CONVENTIONS:
        raise ValueError(
            f"{file}: macros_image_convention is {convention!r}; give --image_convention, "
            f"one of {', '.join(CONVENTIONS)}"
        )
    return convention


def _task_file(file: Path, data: Any) -> Path:
    """Return the task's BDDL file, which the file's attribute names, or else its own name."""
    named = data.attrs.get("bddl_file_name")
    return Path(str(named)) if named else file.with_name(f"{file.stem.removesuffix(SUFFIX)}.bddl")
