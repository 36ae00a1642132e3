"""Result of an episode of `bomb_pusht`: a record of a results file. As light as `results`."""

from dataclasses import dataclass, field
from functools import partial

from lerobot_bomb import __version__
from lerobot_bomb.envs.results import (
    PolicyIdentity,
    ResultLine,
    installed_version,
    installed_versions,
    machine_name,
)
from lerobot_bomb.pusht.episode import IMAGE_SIZE, PUSHT_PROTOCOL_VERSION, PushTSpec

# what the bits of an episode depend on
SIMULATOR = ("gym-pusht", "pymunk", "pygame", "opencv-python-headless")


@dataclass(frozen=True)
class PushTResult(ResultLine):
    """Outcome of one episode; one record in a results file."""

    spec: PushTSpec
    instruction: str
    goal_pose: tuple[float, float, float]  # x, y in pixels of the board, radians
    steps: int
    is_success: bool
    failure: str | None
    coverage: float  # share of the target that the block covers at the end
    max_coverage: float  # the largest after any step
    levels: dict[str, int] = field(default_factory=dict)  # of the perturbation axes that were on
    image_size: int = IMAGE_SIZE
    policy: PolicyIdentity | None = None  # None: not known
    simulator_versions: dict[str, str | None] = field(default_factory=partial(installed_versions, SIMULATOR))
    machine: str = field(default_factory=machine_name)
    lerobot_version: str | None = field(default_factory=partial(installed_version, "lerobot"))
    torch_version: str | None = field(default_factory=partial(installed_version, "torch"))
    package_version: str = __version__
    protocol_version: str = PUSHT_PROTOCOL_VERSION
