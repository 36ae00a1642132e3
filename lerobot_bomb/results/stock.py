"""Records of episodes of LeRobot's own env types, from the few facts that lerobot-eval writes."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, make_dataclass
from functools import cache
from typing import Annotated, Any, ClassVar, Self

from lerobot_bomb.conditions import NONE, AxisCondition, PerturbedSpec
from lerobot_bomb.libero.assets import SUITES
from lerobot_bomb.libero.episode import TASKS_PER_SUITE
from lerobot_bomb.pusht.episode import IMAGE_SIZE
from lerobot_bomb.results import pusht, schema
from lerobot_bomb.results.libero import SIMULATOR, describe_numbered_tasks, task_flags
from lerobot_bomb.results.measures import mean_measure
from lerobot_bomb.results.origin import describe_versions, installed_version
from lerobot_bomb.results.record import Record
from lerobot_bomb.results.schema import Natural

FAILED = "failed"  # the only class: why is not known


@dataclass(frozen=True)
class StockSpec(PerturbedSpec):
    """Episode of an evaluation, as far as LeRobot tells which one it was."""

    seed: Natural  # the episode's seed
    suite: str  # LeRobot's name of the group of tasks
    task_id: Natural  # number of the task in its suite
    # number of the episode in its evaluation, which chooses its start; null: the seed does
    number: Natural | None
    perturbations: Annotated[str, schema.among((NONE,))] = NONE  # always none

    def __post_init__(self) -> None:
        object.__setattr__(self, "perturbations", AxisCondition(self.perturbations))


@dataclass(frozen=True, kw_only=True)
class StockResult(Record):
    """Outcome of one episode of LeRobot's own env types; `stock_result` makes a subclass for each."""

    simulator: ClassVar[Sequence[str]]  # packages that the bits of an episode depend on
    drawn_size: ClassVar[str | None] = None  # width and height of its images, whatever its flags say
    tasks: ClassVar = ()  # whatever LeRobot takes
    condition: ClassVar = AxisCondition
    drawn: ClassVar = ("task_id", "number")
    start: ClassVar = ("seed", "task_id")  # tasks have scenes of their own
    measures: ClassVar = (
        mean_measure("max_reward", "max reward", "mean over episodes"),
        mean_measure("sum_reward", "sum of rewards", "mean over episodes"),
    )
    has_results_path: ClassVar = False

    spec: StockSpec
    sum_reward: float  # sum of the rewards
    max_reward: float  # largest reward
    failure: Annotated[str, schema.among((FAILED,))] | None
    image_size: str
    flags: dict[str, Any]  # {flag of the environment that decides what an episode is: its value}
    simulator_versions: dict[str, str | None]  # {package of the simulator: its version}

    def settings(self) -> dict[str, str]:
        flags = {name: json.dumps(value) for name, value in sorted(self.flags.items()) if value is not None}
        return {"simulator": describe_versions(self.simulator_versions), **flags}

    @classmethod
    def describe_tasks(cls, records: Sequence[Self]) -> str:
        return describe_numbered_tasks([each.spec for each in records])

    def benchmark(self) -> str:
        return f"LeRobot's {self.env_type}"

    @classmethod
    def eval_flags(cls, records: Sequence[Self]) -> list[str]:
        flags = {name: value for name, value in records[0].flags.items() if value is not None}
        flags |= task_flags([each.spec for each in records]) if cls.starts_by_number else {}
        return [*cls.env_flags(flags), "--eval.use_async_envs=false"]


def stock_result(env_type: str, **facts: Any) -> type[StockResult]:
    """Make the type of the records of an env type; `facts` are its class variables."""
    version = f"lerobot-{env_type}-1.0"
    packages = (f"gym-{env_type}", env_type, "gymnasium", "mujoco")
    known = {"env_type": env_type, "versions": {version: ()}}
    known |= {"simulator": [*filter(installed_version, packages)]}
    return make_dataclass(
        f"Stock{env_type.title()}Result",
        [("protocol_version", str, version)],
        bases=(StockResult,),
        namespace=known | facts,
        frozen=True,
        kw_only=True,
    )


unregistered_result = cache(stock_result)  # of an env type of which only the name is known
StockPushTResult = stock_result(
    "pusht", tasks=("PushT-v0",), simulator=pusht.SIMULATOR, drawn_size=f"{IMAGE_SIZE}x{IMAGE_SIZE}"
)
StockLiberoResult = stock_result(
    "libero", tasks=SUITES, suite_sizes=TASKS_PER_SUITE, simulator=SIMULATOR, starts_by_number=True
)
StockLiberoPlusResult = stock_result("libero_plus", simulator=SIMULATOR, starts_by_number=True)
