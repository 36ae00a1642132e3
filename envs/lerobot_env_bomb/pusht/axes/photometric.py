"""Perturbation axis `photometric`: the camera's sensor."""

from lerobot_bomb.envs.perturbation import SensorTransform
from lerobot_env_bomb.pusht.board import PushTTransform


class PushTSensor(SensorTransform, PushTTransform):
    """Colour balance, brightness and noise of the camera's sensor."""
