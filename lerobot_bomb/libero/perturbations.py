"""LIBERO's perturbation axes: their names, levels and magnitudes; the one definition."""

from dataclasses import replace
from functools import partial
from typing import ClassVar

from lerobot_bomb.bomb.perturbations import AXES as BOMB_AXES
from lerobot_bomb.conditions import Axis, AxisCondition, Magnitude, axes_of, magnitude_of

# Append only: an axis' place in this dict numbers its stream of random numbers.
_OWN = {
    "table": Axis(
        "colour and pattern of table and floor",
        ("images",),
        {
            "color": Magnitude("share", (0.12, 0.24, 0.36, 0.48, 0.6), "of the way to a random colour"),
            "pattern": Magnitude(
                "share", (0.06, 0.12, 0.2, 0.3, 0.45), "contrast of stripes, checks or speckles"
            ),
        },
        "lerobot_env_bomb.libero.axes.table:SurfaceLook",
    ),
    "reflectance": Axis(
        "gloss of objects; lamps' reflections on table and floor",
        ("images",),
        {
            "glare": Magnitude(
                "share",
                (0.16, 0.32, 0.48, 0.64, 0.8),
                "opacity of lamps' reflections, drawn on table and floor",
            ),
            "gloss": Magnitude("share", (0.1, 0.2, 0.3, 0.4, 0.5), "of the way to full specular light"),
        },
        "lerobot_env_bomb.libero.axes.reflectance:LiberoGloss",
    ),
    "distractors": Axis(
        "boxes, cylinders and balls that stand beside the objects",
        ("images",),
        {"count": Magnitude("bodies", (1, 2, 3, 4, 5), "more in the scene")},
        "lerobot_env_bomb.libero.axes.distractors:Distractors",
    ),
    "start": Axis(
        "where objects and the arm are at the start",
        ("images", "scene"),
        {
            "objects": Magnitude(
                "mm", (10, 20, 30, 40, 50), "of each that stands free, in a random direction"
            ),
            "arm": Magnitude(
                "radians", (0.04, 0.08, 0.12, 0.16, 0.2), "of its joints, root of sum of squares"
            ),
        },
        "lerobot_env_bomb.libero.axes.start:LiberoStart",
    ),
    "photometric": replace(
        BOMB_AXES["photometric"], transform="lerobot_env_bomb.libero.axes.photometric:LiberoSensor"
    ),
    "camera": Axis(
        "angle, field of view and distance of the cameras; what was in view stays in view",
        ("images",),
        {
            "angle": Magnitude("degrees", (4, 8, 12, 16, 20), "around the table, in a random direction"),
            "wrist_angle": Magnitude("degrees", (1, 2, 3, 4, 5), "around the gripper, in a random direction"),
            "fov": Magnitude("share", (0.04, 0.08, 0.12, 0.16, 0.2), "wider or narrower, both cameras"),
            "distance": Magnitude(
                "share", (0.03, 0.06, 0.09, 0.12, 0.15), "further or nearer, the scene's camera"
            ),
        },
        "lerobot_env_bomb.libero.axes.camera:LiberoCamera",
    ),
    "light": replace(BOMB_AXES["light"], transform="lerobot_env_bomb.libero.axes.light:LiberoLight"),
    "language": replace(
        BOMB_AXES["language"], transform="lerobot_env_bomb.libero.axes.language:LiberoWording"
    ),
    "dynamics": Axis(
        "mass and friction of the objects, noise and latency of the arm",
        ("dynamics",),
        {
            "mass": Magnitude("factor", (1.2, 1.4, 1.7, 2.0, 2.5), "multiplies or divides the mass"),
            "friction": Magnitude("factor", (1.1, 1.2, 1.35, 1.5, 1.7), "multiplies or divides the friction"),
            "noise": Magnitude(
                "share", (0.02, 0.04, 0.06, 0.08, 0.1), "of the range, standard deviation on executed motion"
            ),
            "latency": Magnitude("control steps", (0, 0, 1, 1, 2), "before an action is executed"),
        },
        "lerobot_env_bomb.libero.axes.dynamics:LiberoDynamics",
    ),
    "object": Axis(
        "shade of the objects",
        ("images",),
        {
            "shade": Magnitude("factor", (0.87, 0.75, 0.64, 0.55, 0.47), "of their colour"),
            "tint": Magnitude("share", (0.04, 0.08, 0.12, 0.16, 0.2), "less of one random channel"),
        },
        "lerobot_env_bomb.libero.axes.object:ObjectShade",
    ),
}
LIBERO_AXES = axes_of("bomb_libero", _OWN)
libero_magnitude = partial(magnitude_of, LIBERO_AXES)  # (axis, name, level)


class LiberoCondition(AxisCondition):
    """Condition of LIBERO, by the axes that are on: "camera:2+light:3"."""

    axes: ClassVar = LIBERO_AXES
