"""Perturbation axis `photometric`: the cameras' sensors."""

from lerobot_bomb.envs.perturbation import SensorTransform
from lerobot_env_bomb.libero.scene import LiberoTransform


class LiberoSensor(SensorTransform, LiberoTransform):
    """Colour balance, brightness and noise of the cameras' sensors."""
