"""Record of an episode of `bomb_libero`: its fields, its checks, and its measures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any, ClassVar, Protocol, Self

from lerobot_bomb.libero.assets import SUITES
from lerobot_bomb.libero.episode import (
    LIBERO_PROTOCOL_VERSION,
    RENDER_PRESETS,
    TASKS_PER_SUITE,
    LiberoFailure,
    LiberoSpec,
)
from lerobot_bomb.libero.perturbations import LiberoCondition
from lerobot_bomb.results import schema
from lerobot_bomb.results.origin import describe_versions, installed_versions
from lerobot_bomb.results.record import Record, describe_numbers
from lerobot_bomb.results.schema import Count, Natural

# packages that the bits of an episode depend on
SIMULATOR = ("mujoco", "robosuite", "hf-libero", "numpy")


class TaskSpec(Protocol):
    """Spec of an episode of a numbered task of a suite."""

    @property
    def suite(self) -> str: ...
    @property
    def task_id(self) -> int: ...


def numbers_by_suite(specs: Sequence[TaskSpec]) -> dict[str, set[int]]:
    """Return {suite: numbers of its tasks}."""
    numbers: dict[str, set[int]] = {}
    for spec in specs:
        numbers.setdefault(spec.suite, set()).add(spec.task_id)
    return numbers


def describe_numbered_tasks(specs: Sequence[TaskSpec]) -> str:
    """Describe tasks as 'libero_spatial tasks 0..2'."""
    numbers = numbers_by_suite(specs)
    return ", ".join(f"{suite} tasks {describe_numbers(ids)}" for suite, ids in numbers.items())


def task_flags(specs: Sequence[TaskSpec]) -> dict[str, Any]:
    """Return lerobot-eval's flags, without `--env.`, for the tasks of episodes."""
    numbers = numbers_by_suite(specs)
    return {"task": ",".join(numbers), "task_ids": sorted(set().union(*numbers.values()))}


@dataclass(frozen=True, kw_only=True)
class LiberoResult(Record):
    """Outcome of one episode of `bomb_libero`."""

    env_type: ClassVar = "bomb_libero"
    condition: ClassVar = LiberoCondition
    versions: ClassVar = {LIBERO_PROTOCOL_VERSION: ()}
    earlier: ClassVar = {**Record.earlier, "render_preset": RENDER_PRESETS[0]}
    comparable: ClassVar = {"render_preset": ()}
    drawn: ClassVar = ("task_id",)
    start: ClassVar = ("seed", "task_id")  # tasks have scenes of their own
    tasks: ClassVar = SUITES
    failures: ClassVar = LiberoFailure
    suite_sizes: ClassVar = TASKS_PER_SUITE
    sweep_batch: ClassVar = 1  # starting a simulator takes longer than a batch saves

    spec: LiberoSpec
    instruction: str  # text that the policy read
    initial_state: Natural  # number of the task's recorded state in which the episode started
    steps: Count  # control steps
    failure: Annotated[str, schema.among(LiberoFailure)] | None
    image_size: str = "256x256"
    render_preset: Annotated[str, schema.among(RENDER_PRESETS)] = RENDER_PRESETS[0]  # --env.render_preset
    control_mode: str = "relative"  # --env.control_mode
    fps: Count = 20  # control steps per second
    # {package on which the bits of an episode depend: its version}
    simulator_versions: dict[str, str | None] = field(default_factory=partial(installed_versions, SIMULATOR))
    protocol_version: str = LIBERO_PROTOCOL_VERSION

    def check_episode(self) -> None:
        most = self.spec.max_steps
        self.refuse_if(most is not None and self.steps > most, "steps", "spec.max_steps")

    def settings(self) -> dict[str, str]:
        return {
            "simulator": describe_versions(self.simulator_versions),
            "control_mode": self.control_mode,
            "fps": str(self.fps),
            "render_preset": self.render_preset,
        }

    @classmethod
    def describe_simulator(cls, settings: Mapping[str, str]) -> str:
        drawn = f"render_preset {settings['render_preset']}"
        return f"{settings['control_mode']} control, {settings['fps']} Hz, {drawn}, {settings['simulator']}"

    @classmethod
    def describe_tasks(cls, records: Sequence[Self]) -> str:
        return describe_numbered_tasks([each.spec for each in records])

    def benchmark(self) -> str:
        return f"LIBERO with BOMB's axes, protocol {LIBERO_PROTOCOL_VERSION}"

    @classmethod
    def eval_flags(cls, records: Sequence[Self]) -> list[str]:
        first = records[0]
        width, height = first.image_size.split("x")
        flags = task_flags([each.spec for each in records])
        flags |= {"control_mode": first.control_mode, "fps": first.fps}
        flags |= {"observation_height": height, "observation_width": width}
        flags |= {"render_preset": first.render_preset}
        steps = first.spec.max_steps
        return cls.env_flags(flags | ({} if steps is None else {"episode_length": steps}))
