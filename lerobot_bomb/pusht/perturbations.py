"""PushT's perturbation axes: their names, levels and magnitudes; the one definition.

A pixel is one of the board's 512x512, the unit of positions and actions.
"""

from dataclasses import replace
from functools import partial
from typing import ClassVar

from lerobot_bomb.bomb.perturbations import AXES as BOMB_AXES
from lerobot_bomb.conditions import Axis, AxisCondition, Magnitude, axes_of, magnitude_of

# Append only: an axis' place in this dict numbers its stream of random numbers. `language` stands before
# `goal`, which adds its words to whatever sentence there is.
_OWN = {
    "table": Axis(
        "colour and pattern of the board",
        ("images",),
        {
            "color": Magnitude(
                "share", (0.2, 0.4, 0.6, 0.8, 1.0), "of the way from white to a random colour"
            ),
            "pattern": Magnitude(
                "share", (0.05, 0.09, 0.13, 0.17, 0.21), "darkness of stripes, checks or speckles"
            ),
        },
        "lerobot_env_bomb.pusht.axes.table:BoardLook",
    ),
    "start": Axis(
        "where block and agent are at the start",
        ("images", "scene"),
        {
            "block": Magnitude("pixels", (20, 40, 60, 80, 100), "of the block, towards the board's middle"),
            "turn": Magnitude("degrees", (15, 30, 45, 60, 75), "of the block, to a random side"),
            "agent": Magnitude("pixels", (20, 40, 60, 80, 100), "of the agent, towards the board's middle"),
        },
        "lerobot_env_bomb.pusht.axes.start:PushTStart",
    ),
    "photometric": replace(
        BOMB_AXES["photometric"], transform="lerobot_env_bomb.pusht.axes.photometric:PushTSensor"
    ),
    "language": replace(BOMB_AXES["language"], transform="lerobot_env_bomb.pusht.axes.language:PushTWording"),
    "dynamics": Axis(
        "damping and friction of the block, latency and noise of the agent",
        ("dynamics",),
        {
            "glide": Magnitude(
                "s", (0.02, 0.04, 0.06, 0.08, 0.1), "in which a block let alone loses 63 % of its speed"
            ),
            "friction": Magnitude("coefficient", (0.1, 0.2, 0.3, 0.4, 0.5), "between agent and block"),
            "noise": Magnitude("pixels", (2, 4, 6, 8, 10), "standard deviation on the executed x and y"),
            "latency": Magnitude("control steps", (0, 0, 1, 1, 2), "before an action is executed"),
        },
        "lerobot_env_bomb.pusht.axes.dynamics:PushTDynamics",
    ),
    "object": Axis(
        "shade of the block",
        ("images",),
        {"shade": Magnitude("share", (0.2, 0.4, 0.6, 0.8, 1.0), "of the way to a random colour")},
        "lerobot_env_bomb.pusht.axes.object:BlockShade",
    ),
    "goal": Axis(
        "where the target lies, which the instruction then says",
        ("images", "instruction", "goal"),
        {
            "shift": Magnitude("pixels", (16, 32, 48, 64, 80), "of the target, in a random direction"),
            "turn": Magnitude("degrees", (12, 24, 36, 48, 60), "of the target, to a random side"),
        },
        "lerobot_env_bomb.pusht.axes.goal:GoalPose",
    ),
    "goal_marker": Axis(
        "the target's outline in red over whatever lies on it",
        ("images",),
        # even steps in an image of 96 pixels
        {"width": Magnitude("pixels", (5, 10, 12, 20, 23), "of the line")},
        "lerobot_env_bomb.pusht.axes.goal_marker:GoalOutline",
        is_help=True,
    ),
}
PUSHT_AXES = axes_of("bomb_pusht", _OWN)
pusht_magnitude = partial(magnitude_of, PUSHT_AXES)  # (axis, name, level)


class PushTCondition(AxisCondition):
    """Condition of PushT, by the axes that are on: "table:2+goal:3"."""

    axes: ClassVar = PUSHT_AXES
