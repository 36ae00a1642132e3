"""Record of an episode of `bomb_pusht`: its fields, its checks, and its measures."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, ClassVar, Self

import numpy as np

from lerobot_bomb.bootstrap import bca_interval
from lerobot_bomb.pusht.episode import (
    ALMOST_COVERAGE,
    IMAGE_SIZE,
    MAX_IMAGE_SIZE,
    MIN_IMAGE_SIZE,
    PUSHT_PROTOCOL_VERSION,
    SUCCESS_COVERAGE,
    PushTFailure,
    PushTSpec,
)
from lerobot_bomb.pusht.perturbations import PushTCondition
from lerobot_bomb.results import schema
from lerobot_bomb.results.measures import mean_measure
from lerobot_bomb.results.origin import describe_versions, installed_versions
from lerobot_bomb.results.record import Record
from lerobot_bomb.results.schema import Count
from lerobot_bomb.stats import format_bounds

# packages that the bits of an episode depend on
SIMULATOR = ("gym-pusht", "pymunk", "pygame", "opencv-python-headless")
# rounding may make the covered area larger than the target's
Coverage = Annotated[float, schema.between(0, 1 + 1e-9)]


@dataclass(frozen=True, kw_only=True)
class PushTResult(Record):
    """Outcome of one episode of `bomb_pusht`."""

    env_type: ClassVar = "bomb_pusht"
    condition: ClassVar = PushTCondition
    versions: ClassVar = {PUSHT_PROTOCOL_VERSION: ()}
    tasks: ClassVar = ("pusht",)
    failures: ClassVar = PushTFailure
    measures: ClassVar = (
        mean_measure("max_coverage", "max coverage", "mean, 95 % bootstrap interval over episodes"),
        mean_measure("coverage", "final coverage"),
    )

    spec: PushTSpec
    instruction: str  # text that the policy read
    goal_pose: tuple[float, float, float]  # target: x and y in pixels of the board, radians
    steps: Count  # control steps
    failure: Annotated[str, schema.among(PushTFailure)] | None
    coverage: Coverage  # share of the target that the block covers at the end
    max_coverage: Coverage  # largest coverage after any step
    image_size: Annotated[int, schema.between(MIN_IMAGE_SIZE, MAX_IMAGE_SIZE)] = IMAGE_SIZE
    # {package on which the bits of an episode depend: its version}
    simulator_versions: dict[str, str | None] = field(default_factory=partial(installed_versions, SIMULATOR))
    protocol_version: str = PUSHT_PROTOCOL_VERSION

    def check_episode(self) -> None:
        self.refuse_if(self.steps > self.spec.max_steps, "steps", "spec.max_steps")
        self.refuse_if(self.coverage > self.max_coverage, "coverage", "max_coverage")
        is_covered = self.coverage > SUCCESS_COVERAGE
        self.refuse_if(is_covered != self.is_success, "coverage", "is_success")
        is_almost = self.failure == PushTFailure.ALMOST and self.coverage < ALMOST_COVERAGE
        self.refuse_if(is_almost, "coverage", "failure")

    def settings(self) -> dict[str, str]:
        return {"simulator": describe_versions(self.simulator_versions)}

    @classmethod
    def describe_tasks(cls, records: Sequence[Self]) -> str:
        return "task pusht"

    def benchmark(self) -> str:
        return f"PushT with BOMB's axes, protocol {PUSHT_PROTOCOL_VERSION}"

    @classmethod
    def eval_flags(cls, records: Sequence[Self]) -> list[str]:
        spec, image_size = records[0].spec, records[0].image_size
        return cls.env_flags(
            {"instruction": spec.instruction, "max_steps": spec.max_steps, "image_size": image_size}
        )

    @classmethod
    def describe_change(cls, pairs: Sequence[tuple[Self, Self]]) -> str:
        """Describe the mean change of (before, after) pairs as 'max coverage -0.120 [-0.200, -0.040]'."""
        changes = np.array([after.max_coverage - before.max_coverage for before, after in pairs])
        interval = bca_interval(changes, np.ones(len(pairs)))
        return f"max coverage {changes.mean():+.3f}{format_bounds(interval, '+.3f')}"
