"""Result of an episode of LeRobot's own `pusht` and `libero`: a record of a results file.

lerobot-eval itself tells little of it.
"""

from dataclasses import dataclass, field
from functools import partial
from typing import Any

from lerobot_bomb import __version__
from lerobot_bomb.conditions import NONE
from lerobot_bomb.envs.results import PolicyIdentity, ResultLine, installed_version, machine_name

STOCK_PROTOCOLS = {"pusht": "lerobot-pusht-1.0", "libero": "lerobot-libero-1.0"}  # by --env.type
FAILED = "failed"  # the only class: why is not known


@dataclass(frozen=True)
class StockSpec:
    """Episode of an evaluation, as far as LeRobot tells which one it was."""

    seed: int
    suite: str  # what LeRobot calls a group of tasks
    task_id: int
    number: int | None  # in the evaluation, where that chooses how it starts; None: the seed does
    perturbations: str = NONE  # there are no others


@dataclass(frozen=True)
class StockResult(ResultLine):
    """Outcome of one episode; one record in a results file."""

    spec: StockSpec
    sum_reward: float
    max_reward: float
    is_success: bool
    failure: str | None
    image_size: str  # width and height in pixels
    flags: dict[str, Any]  # of the environment, that decide what an episode is
    simulator_versions: dict[str, str | None]
    protocol_version: str
    policy: PolicyIdentity | None = None  # None: not known
    levels: dict[str, int] = field(default_factory=dict)  # of perturbation axes: none
    machine: str = field(default_factory=machine_name)
    lerobot_version: str | None = field(default_factory=partial(installed_version, "lerobot"))
    torch_version: str | None = field(default_factory=partial(installed_version, "torch"))
    package_version: str = __version__
