"""BOMB: precise placement benchmark and vision-language-action policies for LeRobot."""

__version__ = "0.1.0"
