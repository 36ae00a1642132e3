"""The perturbation axes, one file each; their levels and magnitudes: `lerobot_bomb.bomb.perturbations`."""

from lerobot_env_bomb.axes.camera import Camera
from lerobot_env_bomb.axes.dynamics import Dynamics
from lerobot_env_bomb.axes.goal_marker import GoalMarker
from lerobot_env_bomb.axes.language import Wording
from lerobot_env_bomb.axes.light import Light
from lerobot_env_bomb.axes.object import StoneLook
from lerobot_env_bomb.axes.photometric import Sensor
from lerobot_env_bomb.axes.reflectance import Reflectance
from lerobot_env_bomb.axes.start import Start
from lerobot_env_bomb.axes.stones import Stones
from lerobot_env_bomb.axes.table import Table
from lerobot_env_bomb.axes.transform import Transform

TRANSFORMS: dict[str, type[Transform]] = {
    "table": Table,
    "reflectance": Reflectance,
    "stones": Stones,
    "start": Start,
    "photometric": Sensor,
    "camera": Camera,
    "light": Light,
    "language": Wording,
    "dynamics": Dynamics,
    "object": StoneLook,
    "goal_marker": GoalMarker,
}
