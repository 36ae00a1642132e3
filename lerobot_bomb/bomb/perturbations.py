"""BOMB's perturbation axes: their names, levels and magnitudes.

The one definition: the simulator applies it, ``docs/perturbations.md`` is generated from it.
"""

from functools import partial
from typing import ClassVar

from lerobot_bomb.conditions import Axis, AxisCondition, Magnitude, axes_of, magnitude_of, nuisances_of

# Append only: an axis' place in this dict numbers its stream of random numbers.
# Level 5 must be hard for a policy. The expert ignores images, so it cannot tell; hence these floors:
# camera 15 degrees and 20 % of the field of view, light x4 between its extremes, mass x2, latency 1 step,
# start 80 mm.
_OWN = {
    "table": Axis(
        "colour and pattern of the table, colour of the tray",
        ("images",),
        {
            "color": Magnitude("share", (0.2, 0.4, 0.6, 0.8, 1.0), "of the way to a random colour"),
            "pattern": Magnitude(
                "share", (0.06, 0.12, 0.2, 0.3, 0.45), "contrast of stripes, checks or speckles on the table"
            ),
        },
        "lerobot_env_bomb.bomb.axes.table:TableLook",
    ),
    "reflectance": Axis(
        "gloss of stones, tray and table; a lamp's reflection on the board",
        ("images",),
        {
            "gloss": Magnitude(
                "share", (0.08, 0.16, 0.24, 0.32, 0.4), "specular light of stones, tray and table"
            ),
            "glare": Magnitude(
                "share", (0.08, 0.16, 0.24, 0.32, 0.4), "opacity of a lamp's reflection, drawn on the board"
            ),
        },
        "lerobot_env_bomb.bomb.axes.reflectance:Reflectance",
    ),
    "stones": Axis(
        "number of stones on the board, and their shift off the intersections",
        ("images", "scene"),
        {
            "extra": Magnitude("stones", (1, 1, 2, 2, 3), "additional on the board"),
            "shift": Magnitude("mm", (0.8, 1.6, 2.4, 3.2, 4.0), "of each stone, in a random direction"),
        },
        "lerobot_env_bomb.bomb.axes.stones:Stones",
    ),
    "start": Axis(
        "where the gripper and the stone to be moved are at the start",
        ("images", "scene"),
        {
            "stone": Magnitude(
                "mm", (16, 32, 48, 64, 82), "shift of the stones in the tray, to a random side"
            ),
            "gripper": Magnitude("mm", (16, 32, 48, 64, 82), "shift of the gripper, in a random direction"),
        },
        "lerobot_env_bomb.bomb.axes.start:Start",
    ),
    "photometric": Axis(
        "colour balance, brightness and noise of the camera's sensor",
        ("images",),
        {
            "balance": Magnitude("share", (0.04, 0.08, 0.12, 0.17, 0.22), "up or down, one random channel"),
            "brightness": Magnitude("share", (0.03, 0.06, 0.09, 0.12, 0.15), "up or down, all channels"),
            "noise": Magnitude("grey levels", (2, 4, 6, 8, 11), "standard deviation in each pixel"),
        },
        "lerobot_env_bomb.bomb.axes.photometric:Sensor",
    ),
    "camera": Axis(
        "angle, field of view and distance of the cameras; board, tray and stone stay in view",
        ("images",),
        {
            "angle": Magnitude("degrees", (3, 6, 9, 12.5, 16), "around the board, in a random direction"),
            "wrist_angle": Magnitude("degrees", (1, 2, 3, 4, 5), "around the grip, in a random direction"),
            "fov": Magnitude("share", (0.04, 0.08, 0.12, 0.16, 0.2), "wider or narrower, both cameras"),
            "distance": Magnitude(
                "share", (0.03, 0.06, 0.09, 0.12, 0.15), "further or nearer, the workspace camera"
            ),
        },
        "lerobot_env_bomb.bomb.axes.camera:Camera",
    ),
    "light": Axis(
        "intensity and direction of the light",
        ("images",),
        {
            "dim": Magnitude("factor", (0.88, 0.77, 0.67, 0.58, 0.5), "on all light, if it is dimmed"),
            "bright": Magnitude("factor", (1.15, 1.32, 1.52, 1.75, 2.0), "on all light, if it is brightened"),
            "tilt": Magnitude("degrees", (7, 14, 21, 28, 35), "of the lamp, in a random direction"),
        },
        "lerobot_env_bomb.bomb.axes.light:Light",
    ),
    "language": Axis(
        "wording of the instruction; it stays unambiguous",
        ("instruction",),
        {"form": Magnitude("number", (1, 2, 3, 4, 5), "form of the instruction")},
        "lerobot_env_bomb.bomb.axes.language:Wording",
    ),
    "dynamics": Axis(
        "mass and friction of the stones, noise and latency of the arm",
        ("dynamics",),
        {
            "mass": Magnitude("factor", (1.15, 1.3, 1.5, 1.75, 2.0), "multiplies or divides the mass"),
            "friction": Magnitude("factor", (1.05, 1.1, 1.2, 1.3, 1.4), "multiplies or divides the friction"),
            "noise": Magnitude(
                "40 mm",
                (0.01, 0.02, 0.03, 0.04, 0.05),
                "standard deviation on executed x, y and z; 0.01 is 0.4 mm",
            ),
            "latency": Magnitude("control steps", (0, 0, 0, 1, 1), "before an action is executed"),
        },
        "lerobot_env_bomb.bomb.axes.dynamics:Dynamics",
    ),
    "object": Axis(
        "size, shape and shade of the stones",
        ("images", "scene"),
        {
            "radius": Magnitude("mm", (0.4, 0.8, 1.2, 1.6, 2.0), "more or less than 13 mm"),
            "height": Magnitude("mm", (0.5, 1.0, 1.5, 2.0, 2.5), "more or less than 9 mm"),
            "shade": Magnitude("share", (0.06, 0.12, 0.19, 0.25, 0.32), "of the way to grey, both colours"),
            "flat": Magnitude("1 = yes", (0, 0, 1, 1, 1), "flat discs, not lens-shaped stones"),
        },
        "lerobot_env_bomb.bomb.axes.object:StoneLook",
    ),
    "goal_marker": Axis(
        "a blue dot on the target",
        ("images",),
        {"radius": Magnitude("mm", (3, 4.5, 6, 8, 10), "of the dot")},
        "lerobot_env_bomb.bomb.axes.goal_marker:GoalMarker",
        is_help=True,
    ),
}
AXES = axes_of("bomb", _OWN)
NUISANCES = nuisances_of(AXES)  # what `all` stands for
magnitude = partial(magnitude_of, AXES)  # (axis, name, level)


class Condition(AxisCondition):
    """Condition of BOMB, by the axes that are on: "camera:2+light:3"."""

    axes: ClassVar = AXES
