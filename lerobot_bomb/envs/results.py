"""Result of an episode and where it comes from: a record of a results file.

Simulator workers import this module, so it imports neither torch nor LeRobot.
"""

import dataclasses
import json
import platform
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from lerobot_bomb import __version__
from lerobot_bomb.bomb.episode import PROTOCOL_VERSION, EpisodeSpec
from lerobot_bomb.bomb.observation import DEFAULT_IMAGE_SIZE, RenderOptions
from lerobot_bomb.envs.inference import Inference
from lerobot_bomb.files import append_line, check_appendable


@cache
def installed_version(distribution: str) -> str | None:
    """Return the version of a Python package; None where it has no metadata."""
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None


def installed_versions(distributions: Iterable[str]) -> dict[str, str | None]:
    """{distribution: version}; None where one has no metadata."""
    return {name: installed_version(name) for name in distributions}


@cache
def machine_name() -> str:
    """Processor and C library of this machine: "x86_64, AMD EPYC, glibc 2.36".

    Sine and cosine are the library's, in the variant for the processor; their last bits are in every state.
    """
    cpus = Path("/proc/cpuinfo")  # of Linux
    lines = cpus.read_text().splitlines() if cpus.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    parts = (platform.machine(), *models[:1], " ".join(platform.libc_ver()))
    return ", ".join(part for part in parts if part.strip())


@dataclass(frozen=True)
class PolicyIdentity:
    """Policy that acted. One without weights, or built from its config alone, has a type only."""

    type: str
    path: str | None = None  # the checkpoint's folder as it was given, or USER/NAME on the Hub
    revision: str | None = None  # commit on the Hub
    weights_sha256: str | None = None  # of the file of weights; of adapters, of theirs
    settings_sha256: str | None = None  # of the config that it acted with and of the processors' files
    base: str | None = None  # what adapters are loaded on: a folder or USER/NAME@REVISION
    is_in_training: bool = False  # its weights are in no file
    # of episodes that it acted in at once; a policy's arithmetic rounds otherwise in a batch of another size
    batch_size: int | None = None
    batch_row: int | None = None  # which of them this one was
    interventions: tuple[str, ...] = ()  # steps of its preprocessor that change on purpose what it is shown


# of a line: who played, with which tasks beside, and what simulated; the rest is the episode
ORIGIN = {
    "policy", "task_ids", "opengl_vendor", "opengl_renderer", "machine", "mujoco_version",
    "simulator_versions", "lerobot_version", "torch_version", "package_version", "task_version",
    "protocol_version",
}  # fmt: skip
# of a line: what an episode that is played again, bit for bit, has otherwise
MEASURED = {"inference"}

type Row = dict[str, Any]  # a line read back: the fields of a ResultLine


@dataclass(frozen=True, kw_only=True)
class ResultLine:
    """Result of an episode; the fields of its dataclass are the keys of its record."""

    # mean differences of the executed actions, per step and without the gripper; None: fewer than four
    action_j2: float | None = None
    action_j3: float | None = None
    inference: Inference | None = None  # None: no network was asked, or it was not measured

    def to_json(self) -> str:
        """Return the record, a line of JSON: keys in the order of the fields, those of all environments last.

        Raises:
            ValueError: a number is not finite.
        """
        values = dataclasses.asdict(self)
        shared = {each.name: values.pop(each.name) for each in dataclasses.fields(ResultLine)}
        return json.dumps(values | shared, allow_nan=False)


@dataclass(frozen=True)
class EpisodeResult(ResultLine):
    """Outcome of one episode; one record in a results file.

    `target`, `color` are the episode's; what was asked for is in `spec`, where None means drawn.
    """

    spec: EpisodeSpec
    instruction: str
    task_id: int
    target: tuple[int, int] | None  # None: there is not one move to one intersection
    color: str | None
    steps: int
    progress: float  # share of the moves that were made
    is_success: bool
    is_success_bomb_v0: bool
    failure: str | None
    stage: str
    placement_error_mm: float
    nearest_intersection: tuple[int, int]
    collateral_mm: float
    levels: dict[str, int] = field(default_factory=dict)  # of the perturbation axes that were on
    image_size: int = DEFAULT_IMAGE_SIZE
    render_preset: str = RenderOptions.preset
    task_ids: tuple[int, ...] | None = None  # of the whole evaluation; None: not asked for by number
    policy: PolicyIdentity | None = None  # None: not known
    # of the context that drew the observations; None: nothing was drawn
    opengl_vendor: str | None = None
    opengl_renderer: str | None = None
    machine: str = field(default_factory=machine_name)
    mujoco_version: str | None = field(default_factory=partial(installed_version, "mujoco"))
    lerobot_version: str | None = field(default_factory=partial(installed_version, "lerobot"))
    torch_version: str | None = field(default_factory=partial(installed_version, "torch"))
    package_version: str = __version__
    task_version: str = field(kw_only=True)  # of the suite
    protocol_version: str = PROTOCOL_VERSION


def without_measured(row: Row) -> Row:
    """Return the fields of a record that stay the same when its episode is run again."""
    return {name: value for name, value in row.items() if name not in MEASURED}


def check_results_path(path: str | None) -> None:
    """Raise a ValueError unless records can be appended to the file of `--env.results_path`."""
    if path is None:
        return
    try:
        check_appendable(Path(path))
    except OSError as error:
        raise ValueError(f"--env.results_path={path} cannot be written: {error}") from error


def write_result(path: Path | str, result: ResultLine, seed: int) -> None:
    """Append the result of a seed to the file of `--env.results_path`.

    Raises:
        OSError: it could not be written; the file still holds whole lines.
    """
    try:
        append_line(path, result.to_json())
    except OSError as error:
        raise OSError(
            error.errno,
            f"--env.results_path={path}: the result of seed {seed} could not be written "
            f"({error.strerror}); the file holds those before it. Make room or name another file, and "
            "evaluate again: an episode that is run again counts once",
        ) from error
