"""Perturbation axis `photometric`: the cameras' sensor."""

from lerobot_bomb.envs.perturbation import SensorTransform
from lerobot_env_bomb.bomb.axes.transform import Transform


class Sensor(SensorTransform, Transform):
    """Colour balance, brightness and noise of the cameras' sensor."""
