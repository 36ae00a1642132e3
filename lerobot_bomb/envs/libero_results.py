"""Result of an episode of `bomb_libero`: a record of a results file. As light as `results`."""

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
from lerobot_bomb.libero.episode import LIBERO_PROTOCOL_VERSION, LiberoSpec

# what the bits of an episode depend on
SIMULATOR = ("mujoco", "robosuite", "hf-libero", "numpy")


@dataclass(frozen=True)
class LiberoResult(ResultLine):
    """Outcome of one episode; one record in a results file."""

    spec: LiberoSpec
    instruction: str
    initial_state: int  # of the task's recorded ones
    steps: int
    is_success: bool
    failure: str | None
    levels: dict[str, int] = field(default_factory=dict)  # of the perturbation axes that were on
    image_size: str = "256x256"  # width and height in pixels
    control_mode: str = "relative"
    fps: int = 20
    policy: PolicyIdentity | None = None  # None: not known
    simulator_versions: dict[str, str | None] = field(default_factory=partial(installed_versions, SIMULATOR))
    machine: str = field(default_factory=machine_name)
    lerobot_version: str | None = field(default_factory=partial(installed_version, "lerobot"))
    torch_version: str | None = field(default_factory=partial(installed_version, "torch"))
    package_version: str = __version__
    protocol_version: str = LIBERO_PROTOCOL_VERSION
