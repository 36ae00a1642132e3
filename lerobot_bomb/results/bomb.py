"""Record of an episode of `bomb`: its fields, its checks, and its measures."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from statistics import mean, median
from typing import Annotated, ClassVar, Self

import numpy as np

from lerobot_bomb.bomb.board import BOARD, COLORS, task_id
from lerobot_bomb.bomb.environment import Environment, numbered_tasks
from lerobot_bomb.bomb.episode import COLLATERAL_TOLERANCE_MM, PROTOCOL_VERSION, EpisodeSpec, Failure, Stage
from lerobot_bomb.bomb.judge import V0_TOLERANCE_MM
from lerobot_bomb.bomb.observation import (
    CAMERAS,
    DEFAULT_IMAGE_SIZE,
    MAX_IMAGE_SIZE,
    MIN_IMAGE_SIZE,
    RENDER_PRESETS,
    RenderOptions,
)
from lerobot_bomb.bomb.perturbations import Condition
from lerobot_bomb.bomb.suite import FIRST_VERSION, find_suite
from lerobot_bomb.bomb.suites import OWN_SUITES, SUITES
from lerobot_bomb.bootstrap import bca_interval
from lerobot_bomb.conditions import ALL
from lerobot_bomb.flags import one_of
from lerobot_bomb.results import schema
from lerobot_bomb.results.measures import Measure
from lerobot_bomb.results.origin import NOT_RECORDED, installed_version, json_list, uses_sapien
from lerobot_bomb.results.record import Record, describe_numbers
from lerobot_bomb.results.schema import Count, Quantity
from lerobot_bomb.stats import format_bounds, sums_by

OLD_VERSION = "1.0"  # whose records say less
# outcomes of an episode in which the stone was carried and put down somewhere on the board
PUT_DOWN = (None, Failure.WRONG_INTERSECTION, Failure.IMPRECISE, Failure.DISTURBED_OTHERS)
ALL_MADE = (None, Failure.DISTURBED_OTHERS)  # failures of episodes whose moves have all been made
HALF_PITCH_MM = 1000 * BOARD.pitch_m / 2
ROUNDING_MM = 1e-6

Line = Annotated[int, schema.between(0, BOARD.num_lines - 1)]
TaskId = Annotated[int, schema.between(0, len(COLORS) * BOARD.num_lines**2 - 1)]
OwnTaskId = Annotated[int | None, lambda value: value is not None and value >= 0]


def put_down(records: Iterable[Record]) -> "list[EpisodeResult]":
    """Return the records in which the stone was carried and put down on the board."""
    return [each for each in records if isinstance(each, EpisodeResult) and each.failure in PUT_DOWN]


def is_grounded(record: "EpisodeResult") -> bool:
    """Return True if the stone, put down on the board, lies nearest to the intersection that was named."""
    return record.nearest_intersection == record.target


def are_placed(records: Iterable[Record]) -> bool:
    """Return True if all are episodes with one move to one intersection."""
    return all(isinstance(each, EpisodeResult) and each.target is not None for each in records)


def median_error_mm(records: "Iterable[EpisodeResult]") -> float | None:
    """Return the median error of the stones that were put down on the board; None if there are none."""
    errors = [each.placement_error_mm for each in put_down(records)]
    return median(errors) if errors else None


def _placement_error(records: "Sequence[EpisodeResult]") -> str | None:
    error_mm = median_error_mm(records)
    return None if error_mm is None else f"{error_mm:.1f} mm"


def _progress(records: "Sequence[EpisodeResult]") -> str | None:
    """Return the mean progress of episodes of several moves, as text."""
    shares = [each.progress for each in records if each.target is None and each.progress is not None]
    return f"{100 * mean(shares):.1f} %" if shares else None


@dataclass(frozen=True, kw_only=True)
class EpisodeResult(Record):
    """Outcome of one episode of `bomb`.

    `target` and `color` are the episode's own; `spec` holds the requested ones, where None means drawn.
    """

    env_type: ClassVar = "bomb"
    condition: ClassVar = Condition
    versions: ClassVar = {
        OLD_VERSION: (
            "policy", "mujoco_version", "opengl_vendor", "opengl_renderer", "machine", "render_preset",
            "task_ids", "lerobot_version", "torch_version", "task_version",
        ),
        PROTOCOL_VERSION: (),
    }  # fmt: skip
    earlier: ClassVar = {
        **Record.earlier,
        **dict.fromkeys(versions[OLD_VERSION]),
        "machine": NOT_RECORDED,
        "render_preset": NOT_RECORDED,
        "task_version": FIRST_VERSION,
        "task_id": None,
        "progress": None,
        "spec.task_id": None,
        "spec.simulator": "mujoco",
        "sapien_version": None,
    }
    drawn: ClassVar = ("target", "color", "task_id")
    comparable: ClassVar = {"simulator": ("SAPIEN",), "render_preset": ("SAPIEN", "OpenGL")}
    tasks: ClassVar = (*SUITES, ALL)
    failures: ClassVar = Failure
    suite_sizes: ClassVar = {ALL: len(OWN_SUITES)}
    measures: ClassVar = (
        Measure("moves made", _progress, "mean share of an episode's moves"),
        Measure("placement error", _placement_error, "median of the stones that were put down"),
    )

    spec: EpisodeSpec
    instruction: str  # text that the policy read
    task_id: OwnTaskId  # number of the episode's task in its suite; null: not recorded
    # row and column of the target; null: more than one move
    target: tuple[Line, Line] | None
    # colour of the stone to be moved; null: more than one move
    color: Annotated[str, schema.among(COLORS)] | None
    steps: Count  # control steps
    # share of the moves that were made; null: not recorded
    progress: Annotated[float | None, lambda value: value is not None and 0 <= value <= 1]
    is_success_bomb_v0: bool  # success by the original benchmark's rule, within 26 mm
    failure: Annotated[str, schema.among(Failure)] | None
    # how far the episode got: start, reached, grasped, lifted, placed
    stage: Annotated[str, schema.among(Stage)]
    placement_error_mm: Quantity  # horizontal distance of the stone from the target
    nearest_intersection: tuple[Line, Line]  # row and column where the stone is
    collateral_mm: Quantity  # largest distance by which another stone was moved
    image_size: Annotated[int, schema.between(MIN_IMAGE_SIZE, MAX_IMAGE_SIZE)] = DEFAULT_IMAGE_SIZE
    # --env.render_preset
    render_preset: Annotated[str, schema.among(RENDER_PRESETS)] = RenderOptions.preset
    # --env.task_ids of the whole evaluation; null: not given
    task_ids: Annotated[tuple[TaskId, ...], lambda value: len(value) > 0] | None = None
    # maker of the OpenGL driver that rendered the images, or Vulkan; null: nothing was rendered
    opengl_vendor: str | None = None
    # the driver's renderer
    opengl_renderer: str | None = None
    # installed MuJoCo
    mujoco_version: str | None = field(default_factory=partial(installed_version, "mujoco"))
    # installed SAPIEN; null: it neither simulated nor drew
    sapien_version: str | None = None
    task_version: str  # version of the suite's episodes
    protocol_version: str = PROTOCOL_VERSION

    def check_episode(self) -> None:
        spec = self.spec
        versions = dict.fromkeys((FIRST_VERSION, find_suite(spec.suite).version))
        one_of(f"task_version of suite {spec.suite}", self.task_version, tuple(versions))
        for name in ("target", "color"):
            is_another = getattr(spec, name) not in (None, getattr(self, name))
            self.refuse_if(is_another, name, f"spec.{name}")
        needs_sapien = uses_sapien(spec.simulator, self.render_preset)
        self.refuse_if(needs_sapien != (self.sapien_version is not None), "sapien_version")
        self._check_stage()
        self._check_place()
        self._check_tasks()

    def _check_stage(self) -> None:
        """Check stage, failure, progress and errors against each other."""
        is_made = self.failure in ALL_MADE
        self.refuse_if(is_made != (self.stage == Stage.PLACED), "stage", "failure")
        is_untouched = self.failure == Failure.NEVER_REACHED
        self.refuse_if(is_untouched and self.stage != Stage.START, "stage", "failure")
        if self.progress is not None:
            self.refuse_if(is_made != (self.progress == 1), "progress", "failure")
        if is_made:
            is_there = self.placement_error_mm <= self.spec.success_tolerance_mm
            self.refuse_if(not is_there, "placement_error_mm", "failure")
            is_disturbed = self.collateral_mm > COLLATERAL_TOLERANCE_MM
            self.refuse_if(is_disturbed != (self.failure is not None), "collateral_mm", "failure")

    def _check_place(self) -> None:
        """Check where the stone lies, which is known only for one move to one intersection."""
        if self.target is None:
            self.refuse_if(self.is_success_bomb_v0, "is_success_bomb_v0", "target")
            return
        error_mm, is_nearest = self.placement_error_mm, is_grounded(self)
        is_far = error_mm > HALF_PITCH_MM - ROUNDING_MM
        self.refuse_if(not is_nearest and not is_far, "placement_error_mm", "nearest_intersection", "target")
        needs_nearest = self.failure in (*ALL_MADE, Failure.IMPRECISE) or self.is_success_bomb_v0
        self.refuse_if(needs_nearest and not is_nearest, "nearest_intersection", "target", "failure")
        is_wrong = self.failure == Failure.WRONG_INTERSECTION
        self.refuse_if(is_wrong and is_nearest, "nearest_intersection", "target", "failure")
        is_v0_far = self.is_success_bomb_v0 and error_mm > V0_TOLERANCE_MM
        self.refuse_if(is_v0_far, "placement_error_mm", "is_success_bomb_v0")

    def _check_tasks(self) -> None:
        """Check the number of the task, which records of earlier releases do not have."""
        if self.task_id is None:
            return
        spec = self.spec
        self.refuse_if(self.task_id >= find_suite(spec.suite).num_tasks, "task_id")
        self.refuse_if(spec.task_id not in (None, self.task_id), "task_id", "spec.task_id")
        if self.target is not None and self.color is not None and spec.suite == "place":
            self.refuse_if(self.task_id != task_id(self.target, self.color), "task_id", "target", "color")
        if self.task_ids is not None:
            self.refuse_if(self.task_id not in self.task_ids, "task_id", "task_ids")

    def settings(self) -> dict[str, str]:
        opengl = [name for name in (self.opengl_vendor, self.opengl_renderer) if name]
        return {
            "MuJoCo": self.mujoco_version or NOT_RECORDED,
            **({"SAPIEN": self.sapien_version} if self.sapien_version else {}),
            "OpenGL": ", ".join(opengl) or NOT_RECORDED,
            "render_preset": self.render_preset,
            "tasks": self._tasks_key(),
            "task_version": self.task_version,
        }

    def _tasks_key(self) -> str:
        spec = self.spec
        if self.task_ids is not None:
            return json_list(*sorted(self.task_ids))
        if self.protocol_version == OLD_VERSION and spec.target and spec.color:
            return "fixed"  # records of one evaluation of numbered tasks do not tell those of the others
        return json_list(spec.target, spec.color)

    @classmethod
    def describe_simulator(cls, settings: Mapping[str, str]) -> str:
        drawn = f"render_preset {settings['render_preset']}, OpenGL {settings['OpenGL']}"
        sapien = f", SAPIEN {settings['SAPIEN']}" if "SAPIEN" in settings else ""
        return f"{drawn}, MuJoCo {settings['MuJoCo']}{sapien}"

    @classmethod
    def describe_tasks(cls, records: Sequence[Self]) -> str:
        """Describe the tasks: 'tasks 0, 12', or target and colour, each fixed or drawn."""
        first = records[0]
        if first.task_ids is not None:
            return f"tasks {describe_numbers(first.task_ids)}"
        target, color = first.spec.target, first.spec.color
        if target and color:
            return f"tasks {describe_numbers(map(_number, records))}"
        drawn = "drawn" if target is None else f"row {target[0]}, column {target[1]}"
        return f"target {drawn}; colour {color or 'drawn'}"

    def environment(self) -> Environment:
        """Return the record's environment, without depth and tasks, which no record holds."""
        spec = self.spec
        return Environment(
            spec.robot, spec.control_mode, spec.fps, self.image_size, CAMERAS, self.task_version, spec.suite
        )

    def benchmark(self) -> str:
        return f"BOMB, task version {self.task_version}"

    @classmethod
    def eval_flags(cls, records: Sequence[Self]) -> list[str]:
        """Return lerobot-eval's flags for the environment and the tasks of an evaluation."""
        first, specs = records[0], [each.spec for each in records]
        return [*first.environment().eval_flags(), *_changed_flags(first), *_task_flags(specs)]

    @classmethod
    def describe_change(cls, pairs: Sequence[tuple[Self, Self]]) -> str:
        """Return 'placement error +1.2 mm [+0.3, +2.0] where both put the stone down (40 pairs)'."""
        both = [pair for pair in pairs if all(each.failure in PUT_DOWN for each in pair)]
        if not both or any(each.target is None for pair in both for each in pair):
            return ""
        changes = [after.placement_error_mm - before.placement_error_mm for before, after in both]
        changes_mm = np.array(changes)
        interval = bca_interval(*sums_by(changes_mm, [before.spec.seed for before, _ in both]))
        change = f"placement error {changes_mm.mean():+.1f} mm{format_bounds(interval, '+.1f')}"
        return f"{change} where both put the stone down ({len(both)} pairs)"


def _number(record: EpisodeResult) -> int:
    """Return the number of the task of an episode of `place`."""
    return task_id(record.target or (), record.color or "")


def _changed_flags(record: EpisodeResult) -> list[str]:
    """Return the flags of settings that no training fixes, where they are not the default."""
    recorded = vars(record.spec) | {"render_preset": record.render_preset}
    default = {**vars(EpisodeSpec), "render_preset": RenderOptions.preset}
    return [
        f"--env.{name}={recorded[name]}"
        for name in ("split", "success_tolerance_mm", "simulator", "render_preset")
        if recorded[name] not in (default[name], NOT_RECORDED)
    ]


def _task_flags(specs: Sequence[EpisodeSpec]) -> list[str]:
    if ids := numbered_tasks(map(vars, specs)):
        return [f"--env.task_ids={list(ids)}".replace(" ", "")]
    target, color = specs[0].target, specs[0].color
    flags = [] if target is None else [f"--env.target={list(target)}".replace(" ", "")]
    return flags + ([] if color is None else [f"--env.color={color}"])
