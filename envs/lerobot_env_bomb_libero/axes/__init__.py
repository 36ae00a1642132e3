"""The perturbation axes, one file each; their levels and magnitudes: `lerobot_bomb.libero.perturbations`."""

from lerobot_env_bomb_libero.axes.camera import LiberoCamera
from lerobot_env_bomb_libero.axes.distractors import Distractors
from lerobot_env_bomb_libero.axes.dynamics import LiberoDynamics
from lerobot_env_bomb_libero.axes.language import LiberoWording
from lerobot_env_bomb_libero.axes.light import LiberoLight
from lerobot_env_bomb_libero.axes.object import ObjectShade
from lerobot_env_bomb_libero.axes.photometric import LiberoSensor
from lerobot_env_bomb_libero.axes.reflectance import LiberoGloss
from lerobot_env_bomb_libero.axes.start import LiberoStart
from lerobot_env_bomb_libero.axes.table import SurfaceLook
from lerobot_env_bomb_libero.scene import LiberoTransform

LIBERO_TRANSFORMS: dict[str, type[LiberoTransform]] = {
    "table": SurfaceLook,
    "reflectance": LiberoGloss,
    "distractors": Distractors,
    "start": LiberoStart,
    "photometric": LiberoSensor,
    "camera": LiberoCamera,
    "light": LiberoLight,
    "language": LiberoWording,
    "dynamics": LiberoDynamics,
    "object": ObjectShade,
}
