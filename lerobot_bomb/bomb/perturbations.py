"""Perturbation axes: their names, levels and magnitudes, and how a condition of several is written.

The one definition: the simulator applies it, ``docs/perturbations.md`` is generated from it.
"""

import re
from dataclasses import dataclass
from typing import Self

NONE = "none"
ALL = "all"
MAX_LEVEL = 5


@dataclass(frozen=True)
class Magnitude:
    """How far one quantity of an axis moves at the levels 1..5."""

    unit: str
    levels: tuple[float, float, float, float, float]
    what: str


@dataclass(frozen=True)
class Axis:
    """One way to make the task harder that leaves all others alone."""

    summary: str
    changes: tuple[str, ...]  # of a paired episode: images, state, instruction, dynamics
    magnitudes: dict[str, Magnitude]


# Append only: an axis' place in this dict numbers its stream of random numbers.
AXES = {
    "table": Axis(
        "colour and pattern of the table, colour of the tray",
        ("images",),
        {
            "color": Magnitude("share", (0.2, 0.4, 0.6, 0.8, 1.0), "of the way to a drawn colour"),
            "pattern": Magnitude(
                "share", (0.06, 0.12, 0.2, 0.3, 0.45), "contrast of stripes, checks or speckles on the table"
            ),
        },
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
    ),
    "stones": Axis(
        "number of stones on the board, and how exactly they stand",
        ("images", "state"),
        {
            "extra": Magnitude("stones", (1, 1, 2, 2, 3), "more on the board"),
            "shift": Magnitude("mm", (0.8, 1.6, 2.4, 3.2, 4.0), "of each stone, in a drawn direction"),
        },
    ),
    "start": Axis(
        "where the stone to be moved and the gripper are at the start",
        ("images", "state"),
        {
            "stone": Magnitude("mm", (16, 32, 48, 64, 82), "of the stone along the tray, to a drawn side"),
            "gripper": Magnitude("mm", (16, 32, 48, 64, 82), "of the gripper, in a drawn direction"),
        },
    ),
    "photometric": Axis(
        "colour balance, brightness and noise of the camera's sensor",
        ("images",),
        {
            "balance": Magnitude("share", (0.04, 0.08, 0.12, 0.17, 0.22), "up or down, of a drawn channel"),
            "brightness": Magnitude("share", (0.03, 0.06, 0.09, 0.12, 0.15), "up or down, of all channels"),
            "noise": Magnitude("grey levels", (2, 4, 6, 8, 11), "standard deviation, of each pixel"),
        },
    ),
    "camera": Axis(
        "angle, field of view and distance of the cameras; board, tray and stone stay in view",
        ("images",),
        {
            "angle": Magnitude("degrees", (3, 6, 9, 12.5, 16), "around the board, in a drawn direction"),
            "wrist_angle": Magnitude("degrees", (1, 2, 3, 4, 5), "around the grip, in a drawn direction"),
            "fov": Magnitude("share", (0.04, 0.08, 0.12, 0.16, 0.2), "wider or narrower, of both cameras"),
            "distance": Magnitude(
                "share", (0.03, 0.06, 0.09, 0.12, 0.15), "further or nearer, of the workspace's"
            ),
        },
    ),
    "light": Axis(
        "intensity and direction of the light",
        ("images",),
        {
            "dim": Magnitude("factor", (0.88, 0.77, 0.67, 0.58, 0.5), "of all light, if it is dimmed"),
            "bright": Magnitude("factor", (1.15, 1.32, 1.52, 1.75, 2.0), "of all light, if it is brightened"),
            "tilt": Magnitude("degrees", (7, 14, 21, 28, 35), "of the lamp, in a drawn direction"),
        },
    ),
    "language": Axis(
        "how the instruction is worded; what it means is always stated",
        ("instruction",),
        {"form": Magnitude("number", (1, 2, 3, 4, 5), "see below")},
    ),
    "dynamics": Axis(
        "mass and friction of the stones, noise and latency of the arm",
        ("dynamics",),
        {
            "mass": Magnitude("factor", (1.15, 1.3, 1.5, 1.75, 2.0), "times, or divided by"),
            "friction": Magnitude("factor", (1.05, 1.1, 1.2, 1.3, 1.4), "divided by, or times"),
            "noise": Magnitude(
                "40 mm", (0.01, 0.02, 0.03, 0.04, 0.05), "standard deviation on the executed x, y and z"
            ),
            "latency": Magnitude("control steps", (0, 0, 0, 1, 1), "before an action is executed"),
        },
    ),
    "object": Axis(
        "size, shape and shade of the stones",
        ("images", "state"),
        {
            "radius": Magnitude("mm", (0.4, 0.8, 1.2, 1.6, 2.0), "more or less than 13"),
            "height": Magnitude("mm", (0.5, 1.0, 1.5, 2.0, 2.5), "more or less than 9"),
            "shade": Magnitude("share", (0.06, 0.12, 0.19, 0.25, 0.32), "of the way to grey, either colour"),
            "flat": Magnitude("yes", (0, 0, 1, 1, 1), "discs instead of lenses"),
        },
    ),
    # a help, not a nuisance: no part of `all`
    "goal_marker": Axis(
        "a blue dot on the target, as the original benchmark drew it",
        ("images",),
        {"radius": Magnitude("mm", (3, 4.5, 6, 8, 10), "of the dot")},
    ),
}
NUISANCES = tuple(name for name in AXES if name != "goal_marker")  # what `all` stands for


def magnitude(axis: str, name: str, level: int) -> float:
    """How far a quantity of an axis moves at a level of 1..5, in the unit that the table states."""
    return AXES[axis].magnitudes[name].levels[level - 1]


@dataclass(frozen=True)
class Condition:
    """Which axes are on, each at a level or at one drawn per episode from a range of levels."""

    ranges: tuple[tuple[str, int, int], ...] = ()  # (axis, lowest, highest level), in the order of AXES

    @classmethod
    def parse(cls, text: str) -> Self:
        """From "none", "camera:3", "camera:2+light:3" or "all:1-5"; level 0 leaves an axis off.

        Raises:
            ValueError: names --env.perturbations, what is wrong, and what is allowed.
        """
        ranges: dict[str, tuple[int, int]] = {}
        for part in [] if text == NONE else text.split("+"):
            axes, low, high = _parse_part(part, text)
            for axis in axes:
                if axis in ranges:
                    reason = f"; {ALL} includes it" if ALL in text else ""
                    raise ValueError(f"--env.perturbations={text!r} names the axis {axis} twice{reason}")
                ranges[axis] = low, high
        return cls(tuple((axis, *ranges[axis]) for axis in AXES if ranges.get(axis, (0, 0)) != (0, 0)))

    def __str__(self) -> str:
        """As `parse` reads it, the same for all ways to write the same condition."""
        parts = {axis: f"{low}" if low == high else f"{low}-{high}" for axis, low, high in self.ranges}
        shared = {parts.get(axis) for axis in NUISANCES}
        if len(shared) == 1 and shared != {None}:
            parts = {ALL: parts[NUISANCES[0]], **{a: p for a, p in parts.items() if a not in NUISANCES}}
        return "+".join(f"{axis}:{levels}" for axis, levels in parts.items()) or NONE

    @property
    def key(self) -> str:
        """The condition in lower-case letters, digits, dots and hyphens: "camera-2.light-3", "all-1to5"."""
        return str(self).replace("-", "to").replace(":", "-").replace("+", ".").replace("_", "-")


def _parse_part(part: str, text: str) -> tuple[tuple[str, ...], int, int]:
    """Axes, lowest and highest level of "camera:1-5" or "all:3"; `text` is the whole condition."""
    match = re.fullmatch(r"([a-z_]+):(-?\d+)(?:-(\d+))?", part)
    if match is None:
        raise ValueError(
            f"--env.perturbations={text!r}: {part!r} is not a perturbation; write 'none', AXIS:LEVEL or "
            "AXIS:LOW-HIGH, several joined by +, without spaces, capitals and fractions, as 'camera:3', "
            "'camera:2+light:3', 'all:1-5'"
        )
    axis, low, high = match[1], int(match[2]), int(match[3] or match[2])
    if axis != ALL and axis not in AXES:
        raise ValueError(
            f"--env.perturbations={text!r}: {axis!r} is not an axis; choose one of: {', '.join((*AXES, ALL))}"
        )
    if not 0 <= low <= high <= MAX_LEVEL:
        raise ValueError(
            f"--env.perturbations={text!r}: the levels of {axis} must lie in 0..{MAX_LEVEL}, lowest first"
        )
    return NUISANCES if axis == ALL else (axis,), low, high
