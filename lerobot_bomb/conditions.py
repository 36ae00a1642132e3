"""Perturbation axes of an environment: how they are declared, and how a condition of several is written.

An environment has one table of axes; what an axis does there is the environment's own.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar, Self, cast

from lerobot_bomb.registry import Registry

NONE = "none"
ALL = "all"
EACH = "each"
MAX_LEVEL = 5


@dataclass(frozen=True)
class Magnitude:
    """Magnitude of one quantity of an axis at each of the levels 1..5."""

    unit: str
    levels: tuple[float, float, float, float, float]
    what: str


@dataclass(frozen=True)
class Axis:
    """One way to make the task harder, independent of the others."""

    summary: str
    changes: tuple[str, ...]  # of a paired episode: images, state, instruction, goal, dynamics
    magnitudes: dict[str, Magnitude]
    transform: str  # "module:class" of what it does, an `EpisodeTransform`, which only simulators import
    is_help: bool = False  # not a nuisance: no part of `all`


def axes_of(env_type: str, own: Mapping[str, Axis]) -> Registry[Axis]:
    """Return an environment's table of axes, to which other packages add by entry points "ENV_TYPE.AXIS"."""
    return Registry("lerobot_bomb.axes", own, f"{env_type}.")


def magnitude_of(axes: Mapping[str, Axis], axis: str, name: str, level: int) -> float:
    """Return the magnitude of a quantity at a level of 1..5, in the unit that the axis states."""
    return axes[axis].magnitudes[name].levels[level - 1]


def nuisances_of(axes: Registry[Axis]) -> tuple[str, ...]:
    """Return the axes that `all` stands for: all of this package except those that help."""
    return tuple(name for name in axes.own if not axes[name].is_help)


class AxisCondition(str):
    """Axes of an environment that are on, each at one level or at a range to draw from per episode.

    It is a string in canonical spelling, such as "camera:2+light:3". A subclass names its environment's table
    of axes.
    """

    axes: ClassVar[Registry[Axis]] = Registry("", {})
    ranges: tuple[tuple[str, int, int], ...]  # (axis, lowest, highest level), in the order of `axes`

    def __new__(cls, text: str = NONE) -> Self:
        """Parse "none", "camera:3", "camera:2+light:3" or "all:1-5"; level 0 leaves an axis off.

        Raises:
            ValueError: names --env.perturbations, what is wrong, and what is allowed.
        """
        if type(text) is cls:  # every reset of an environment makes a spec of another one
            return text
        ranges = cls._parse(text)
        condition = super().__new__(cls, cls._spell(ranges))
        condition.ranges = ranges
        return condition

    def __deepcopy__(self, memo: object) -> Self:
        return self

    @property
    def key(self) -> str:
        """Condition in lower-case letters, digits, dots and hyphens: "camera-2.light-3", "all-1to5"."""
        return self.replace("-", "to").replace(":", "-").replace("+", ".").replace("_", "-")

    @classmethod
    def groups(cls, perturbations: Sequence[str] | str | None, task: str) -> dict[str, Self]:
        """Return {key of a group of results: its condition}; only the task's for `perturbations=None`.

        Raises:
            ValueError: `perturbations` is no list, is empty, or names a condition twice.
        """
        if perturbations is None:
            return {task: cls()}
        if isinstance(perturbations, str):
            raise ValueError(
                f"--env.perturbations={perturbations} must be a list, with brackets and quotes: "
                f"""--env.perturbations='["none","{next(iter(cls.axes))}:3"]'"""
            )
        if not perturbations:
            raise ValueError('--env.perturbations=[] names no condition; leave it out or give ["none"]')
        conditions = cls.expand(perturbations)
        if len(set(conditions)) < len(conditions):
            raise ValueError(f"--env.perturbations={perturbations} has a condition twice")
        return {f"{task}.{condition.key}": condition for condition in conditions}

    @classmethod
    def expand(cls, perturbations: Sequence[str]) -> list[Self]:
        """Parse conditions; "each:3" stands for every axis at this level, "each:1-5" for every axis at each.

        Raises:
            ValueError: a condition is malformed, or a level is outside 1..MAX_LEVEL.
        """
        conditions: list[Self] = []
        for text in perturbations:
            if not text.startswith(f"{EACH}:"):
                conditions.append(cls(text))
                continue
            match = re.fullmatch(rf"{EACH}:(\d)(?:-(\d))?", text)
            low, high = (0, 0) if match is None else (int(match[1]), int(match[2] or match[1]))
            if not 1 <= low <= high <= MAX_LEVEL:
                raise ValueError(
                    f"--env.perturbations={text!r}: write {EACH}:LEVEL or {EACH}:LOW-HIGH, levels of "
                    f"1..{MAX_LEVEL}, lowest first; it stands for every axis at each of them"
                )
            levels = range(low, high + 1)
            conditions += [cls(f"{axis}:{level}") for axis in nuisances_of(cls.axes) for level in levels]
        return conditions

    @classmethod
    @lru_cache(maxsize=1024)  # many lines of a file have the same
    def _parse(cls, text: str) -> tuple[tuple[str, int, int], ...]:
        ranges: dict[str, tuple[int, int]] = {}
        for part in [] if text == NONE else text.split("+"):
            axes, low, high = cls._parse_part(part, text)
            for axis in axes:
                if axis in ranges:
                    reason = f"; {ALL} includes it" if ALL in text else ""
                    raise ValueError(f"--env.perturbations={text!r} names the axis {axis} twice{reason}")
                ranges[axis] = low, high
        return tuple((axis, *ranges[axis]) for axis in cls.axes if ranges.get(axis, (0, 0)) != (0, 0))

    @classmethod
    def _spell(cls, ranges: tuple[tuple[str, int, int], ...]) -> str:
        parts = {axis: f"{low}" if low == high else f"{low}-{high}" for axis, low, high in ranges}
        nuisances = nuisances_of(cls.axes)
        shared = {parts.get(axis) for axis in nuisances}
        if len(shared) == 1 and shared != {None}:
            parts = {ALL: parts[nuisances[0]], **{a: p for a, p in parts.items() if a not in nuisances}}
        return "+".join(f"{axis}:{levels}" for axis, levels in parts.items()) or NONE

    @classmethod
    def _parse_part(cls, part: str, text: str) -> tuple[tuple[str, ...], int, int]:
        """Return axes, lowest and highest level of "camera:1-5" or "all:3"; `text` is the whole condition."""
        match = re.fullmatch(r"([a-z_]+):(-?\d+)(?:-(\d+))?", part)
        if match is None:
            first, second, *_ = cls.axes
            raise ValueError(
                f"--env.perturbations={text!r}: {part!r} is not a perturbation; write 'none', AXIS:LEVEL or "
                "AXIS:LOW-HIGH, several joined by +, without spaces, capitals and fractions, as "
                f"'{first}:3', '{first}:2+{second}:3', 'all:1-5'"
            )
        axis, low, high = match[1], int(match[2]), int(match[3] or match[2])
        if axis != ALL and axis not in cls.axes:
            allowed = ", ".join((*cls.axes, ALL))
            what = "several conditions, where one is needed" if axis == EACH else "not an axis"
            raise ValueError(f"--env.perturbations={text!r}: {axis!r} is {what}; choose one of: {allowed}")
        if not 0 <= low <= high <= MAX_LEVEL:
            order = ", lowest first" if match[3] else ""
            raise ValueError(
                f"--env.perturbations={text!r}: the levels of {axis} must lie in 0..{MAX_LEVEL}{order}"
            )
        return nuisances_of(cls.axes) if axis == ALL else (axis,), low, high


class PerturbedSpec:
    """Base of specs whose `perturbations` becomes an `AxisCondition`."""

    perturbations: str

    @property
    def condition(self) -> AxisCondition:
        """Axes that are on, with their levels."""
        return cast(AxisCondition, self.perturbations)
