"""Model file of the Fetch arm in gymnasium-robotics, and the check that it can be used here.

Imports neither MuJoCo nor gymnasium-robotics, so that flags are checked at once.
"""

import importlib.metadata
import importlib.util
from pathlib import Path

from lerobot_bomb.bomb.episode import EpisodeSpec

PACKAGE = "gymnasium_robotics"
MODEL_FILE = Path("envs", "assets", "fetch", "reach.xml")  # inside the package
FIRST_MUJOCO_WITHOUT_FETCH = 4  # major version whose reader refuses the model


def check_robot(spec: EpisodeSpec) -> None:
    """Raise a ValueError unless the spec's robot can be built with what is installed."""
    if spec.robot == "fetch":
        fetch_xml()


def fetch_xml() -> Path:
    """Return the MJCF file of the installed Fetch model; a ValueError says why there is none."""
    mujoco_version = importlib.metadata.version("mujoco")
    if int(mujoco_version.split(".")[0]) >= FIRST_MUJOCO_WITHOUT_FETCH:
        raise ValueError(
            f"--env.robot=fetch cannot run with the installed MuJoCo {mujoco_version}: gymnasium-robotics' "
            f"Fetch model needs a MuJoCo below {FIRST_MUJOCO_WITHOUT_FETCH}; install the one that "
            "`lerobot-bomb doctor` names, or choose --env.robot=scara"
        )
    package = importlib.util.find_spec(PACKAGE)
    if package is None or package.origin is None:
        raise ValueError(
            "--env.robot=fetch takes its arm from gymnasium-robotics, which is not installed (MuJoCo "
            f"{mujoco_version} is); pip install gymnasium-robotics or choose --env.robot=scara"
        )
    path = Path(package.origin).parent / MODEL_FILE
    if not path.is_file():
        raise ValueError(
            f"--env.robot=fetch: the installed gymnasium-robotics has no {path} (MuJoCo: {mujoco_version}); "
            "pip install gymnasium-robotics==1.4.2 or choose --env.robot=scara"
        )
    return path
