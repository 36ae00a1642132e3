"""Record of an episode in a results file: the fields of all environments.

Simulator workers import this module, so it imports neither torch nor LeRobot.
"""

import dataclasses
import json
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from operator import attrgetter
from typing import Any, ClassVar, Protocol, Self

from lerobot_bomb import __version__
from lerobot_bomb.bomb.environment import Environment
from lerobot_bomb.conditions import AxisCondition
from lerobot_bomb.failures import FailureClass
from lerobot_bomb.flags import flag_value
from lerobot_bomb.results.inference import Inference
from lerobot_bomb.results.measures import Measure
from lerobot_bomb.results.origin import (
    NOT_RECORDED,
    Evaluation,
    PolicyIdentity,
    installed_version,
    machine_name,
)
from lerobot_bomb.results.schema import Natural, Quantity, impossible

MAX_RUNS = 10  # of numbers, in a heading

# fields of a record that say who acted, in which evaluation, and what simulated; the rest is the episode
ORIGIN = {
    "policy", "task_ids", "evaluation", "opengl_vendor", "opengl_renderer", "machine", "mujoco_version",
    "simulator_versions", "lerobot_version", "torch_version", "package_version", "task_version",
    "protocol_version",
}  # fmt: skip
# fields of a record that differ when an episode is run again, bit for bit; smoothness does not
MEASURED = {"inference"}


class Spec(Protocol):
    """Everything that determines an episode."""

    @property
    def seed(self) -> int: ...
    @property
    def perturbations(self) -> str: ...
    @property
    def condition(self) -> AxisCondition: ...


@dataclass(frozen=True, kw_only=True)
class Record(ABC):
    """Result of an episode.

    A subclass for each environment adds its own fields. Reading checks a field by its type. A new field goes
    into `earlier`.
    """

    env_type: ClassVar[str]
    condition: ClassVar[type[AxisCondition]]  # its perturbations
    # {protocol version: fields that its records lack}, the oldest first; a version tells the environment,
    # so no two environments share one
    versions: ClassVar[Mapping[str, tuple[str, ...]]]
    # {field that records of earlier releases lack: its value in them}
    earlier: ClassVar[Mapping[str, Any]] = {
        "action_j2": None,
        "action_j3": None,
        "inference": None,
        "evaluation": None,
        "policy.training_step": None,
        "policy.batch_size": None,
        "policy.batch_row": None,
        "policy.interventions": (),
        "policy.config_sha256": None,
    }
    # fields of a spec that may differ between pooled episodes, beside seed and perturbations
    drawn: ClassVar[tuple[str, ...]] = ()
    # {setting across which one policy's episodes can be paired: the other settings that differ with it}
    comparable: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    # fields of a spec that are equal in episodes that start alike, which are not independent
    start: ClassVar[tuple[str, ...]] = ("seed",)
    tasks: ClassVar[Sequence[str]]  # values of --env.task
    # {value of --env.task that stands for several tasks: their number}
    suite_sizes: ClassVar[Mapping[str, int]] = {}
    failures: ClassVar[Iterable[FailureClass]] = ()
    measures: ClassVar[Sequence[Measure]] = ()
    has_results_path: ClassVar[bool] = True  # lerobot-eval writes the records, with --env.results_path
    # an episode's number in its evaluation, not its seed, chooses how it starts: in batches of one
    starts_by_number: ClassVar[bool] = False
    sweep_batch: ClassVar[int] = 10  # largest batch of `sweep`, unless --batch_size is given

    spec: Spec
    is_success: bool  # the episode succeeded
    failure: str | None  # failure class; null: success
    # {perturbation axis that was on: its level}
    levels: dict[str, Natural] = field(default_factory=dict)
    image_size: int | str  # width and height of the images in pixels
    policy: PolicyIdentity | None = None  # policy that acted; null: not known
    machine: str = field(default_factory=machine_name)  # processor and C library
    # installed LeRobot
    lerobot_version: str | None = field(default_factory=partial(installed_version, "lerobot"))
    # installed torch
    torch_version: str | None = field(default_factory=partial(installed_version, "torch"))
    package_version: str = __version__  # version of this package
    protocol_version: str  # how results are measured and written
    # mean length of the executed actions' second differences, gripper left out; null: fewer than four actions
    action_j2: Quantity | None = None
    # mean length of the third differences, likewise
    action_j3: Quantity | None = None
    inference: Inference | None = None  # cost of the policy's queries; null: no network, or not measured
    evaluation: Evaluation | None = None  # evaluation that it is of; null: not recorded, or of none

    def as_json(self) -> dict[str, Any]:
        """Return the fields as a JSON object."""
        return dataclasses.asdict(self)

    def to_json(self) -> str:
        """Return the record, a line of JSON.

        Raises:
            ValueError: a number is not finite.
        """
        return json.dumps(self.as_json(), allow_nan=False)

    def check(self) -> None:
        """Raise a ValueError if the fields, each possible by itself, contradict each other."""
        policy, inference = self.policy, self.inference
        if policy is not None and policy.batch_row is not None and policy.batch_size is not None:
            self.refuse_if(policy.batch_row >= policy.batch_size, "policy.batch_row", "policy.batch_size")
        self.refuse_if(self.is_success != (self.failure is None), "is_success", "failure")
        self.check_episode()
        self._check_levels()
        if inference is not None:
            p50, p95 = "inference.latency_p50_ms", "inference.latency_p95_ms"
            self.refuse_if(inference.latency_p50_ms > inference.latency_p95_ms, p50, p95)
            is_too_often = inference.num_queries > getattr(self, "steps", inference.num_queries)
            self.refuse_if(is_too_often, "inference.num_queries", "steps")

    def check_episode(self) -> None:  # noqa: B027  an environment may have none
        """Raise a ValueError that names fields of this environment which contradict each other."""

    def refuse_if(self, is_impossible: bool, first: str, *others: str) -> None:
        """Raise a ValueError that shows fields that are possible alone, but not together."""
        if is_impossible:
            raise impossible({name: attrgetter(name)(self) for name in (first, *others)})

    def _check_levels(self) -> None:
        asked = {axis: (low, high) for axis, low, high in self.spec.condition.ranges}
        if self.protocol_version != [*self.versions][-1]:  # `all` had fewer axes
            asked = {axis: levels for axis, levels in asked.items() if axis in self.levels}
        off = (0, 0)  # of an axis that is not in the condition
        for axis in (*self.levels, *asked):
            low, high = asked.get(axis, off)
            if not low <= self.levels.get(axis, 0) <= high:
                raise ValueError(
                    f"levels={json.dumps(self.levels)} with spec.perturbations={self.spec.perturbations}"
                )

    def describe_policy(self) -> str:
        """Describe which policy acted, as far as the record says."""
        return NOT_RECORDED if self.policy is None else self.policy.describe()

    @property
    def start_key(self) -> tuple[Any, ...]:
        """Key that is equal for records that are not independent."""
        return tuple([getattr(self.spec, name) for name in self.start])

    @abstractmethod
    def settings(self) -> dict[str, str]:
        """Return what pooled episodes must agree in, beside spec, policy, protocol and images."""

    @classmethod
    def describe_simulator(cls, settings: Mapping[str, str]) -> str:
        """Describe simulator and renderer among these settings."""
        return settings["simulator"]

    @classmethod
    @abstractmethod
    def describe_tasks(cls, records: Sequence[Self]) -> str:
        """Describe the tasks of episodes: 'libero_spatial tasks 0..2'."""

    def environment(self) -> Environment | None:
        """Return the record's environment of BOMB; None for other environments."""
        return None

    @abstractmethod
    def benchmark(self) -> str:
        """Name the benchmark with its version, for a model card."""

    @classmethod
    def condition_flags(cls, conditions: Iterable[str]) -> list[str]:
        """Return lerobot-eval's flag of these conditions; [] in an environment that has none."""
        return [f"--env.perturbations={json.dumps([*conditions])}"] if cls.condition.axes else []

    @classmethod
    @abstractmethod
    def eval_flags(cls, records: Sequence[Self]) -> list[str]:
        """Return lerobot-eval's flags for the environment and tasks of episodes."""

    @classmethod
    def num_tasks(cls, flags: Sequence[str]) -> int:
        """Return how many tasks lerobot-eval runs with these flags; 1 if they do not tell."""
        if (task_ids := flag_value(flags, "--env.task_ids")) is not None:
            return task_ids.count(",") + 1
        task = flag_value(flags, "--env.task") or next(iter(cls.tasks), "")
        return cls.suite_sizes.get(task, 1)

    @classmethod
    def env_flags(cls, values: Mapping[str, Any]) -> list[str]:
        """Return lerobot-eval's flags for the environment's type and these settings."""
        texts = {
            name: value if isinstance(value, str) else json.dumps(value) for name, value in values.items()
        }
        return [f"--env.type={cls.env_type}", *(f"--env.{name}={text}" for name, text in texts.items())]

    @classmethod
    def describe_change(cls, pairs: Sequence[tuple[Self, Self]]) -> str:
        """Describe how the second records of pairs differ, apart from successes; '' if they do not."""
        return ""


def outcome_fields(record: Record) -> list[str]:
    """Return the names of the fields of spec and outcome, not of policy, machine and latency.

    Fields that a record of an earlier release lacks are left out.
    """
    missing = object()
    return [
        name
        for name, value in vars(record).items()
        if name not in ORIGIN | MEASURED and value != record.earlier.get(name, missing)
    ]


def different_fields(record: Record, other: Record) -> list[str]:
    """Return the names of the fields of the outcome that differ between two records of one episode."""
    return [name for name in outcome_fields(record) if getattr(record, name) != getattr(other, name, None)]


def describe_numbers(numbers: Iterable[int]) -> str:
    """{0, 1, 2, 7} -> '0..2, 7'; for many runs, the first and the last number."""
    runs: list[list[int]] = []
    for number in sorted(set(numbers)):
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    if len(runs) > MAX_RUNS:
        return f"{runs[0][0]}..{runs[-1][-1]}, with gaps"
    return ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]}..{run[-1]}" for run in runs)
