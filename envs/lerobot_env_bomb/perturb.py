"""Draws what an episode's condition stands for: one frozen transform per axis that is on."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from lerobot_bomb.perturbations import AXES, Condition, magnitude
from lerobot_bomb.schema import BOARD, COLORS, EpisodeSpec
from lerobot_env_bomb.axes import Camera, Dynamics, GoalMarker, Light, Reflectance, StoneLook, Table
from lerobot_env_bomb.go import Cell, is_legal_move, is_legal_position
from lerobot_env_bomb.photometric import Photometric
from lerobot_env_bomb.scene import Layout, ModelEdit
from lerobot_env_bomb.wording import Wording

# Streams of random numbers, beside those of the layout; their numbers are part of the protocol.
LEVEL_STREAM = 100  # plus the axis' place in AXES: the level, where the condition gives a range
AXIS_STREAM = 200  # plus the axis' place: everything else that the axis draws


@dataclass(frozen=True)
class Start:
    """The stone to be moved and the gripper start elsewhere."""

    stone_offset_m: tuple[float, float]  # x, y
    gripper_offset_m: tuple[float, float]

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator) -> Self:
        side = float(rng.choice((-1.0, 1.0)))
        # Towards the board, for beyond the tray is no workspace, and along with the stone, which the arm
        # would else hide from a camera that has swung.
        angle_rad = side * rng.uniform(0.5 * np.pi, 0.75 * np.pi)
        stone_m, gripper_m = (1e-3 * magnitude("start", what, level) for what in ("stone", "gripper"))
        gripper_offset = gripper_m * np.cos(angle_rad), gripper_m * np.sin(angle_rad)
        return cls((0.0, side * stone_m), (float(gripper_offset[0]), float(gripper_offset[1])))

    def __call__(self, layout: Layout, stone: int) -> Layout:
        stone_xy = layout.stone_xy.copy()
        stone_xy[stone] += self.stone_offset_m
        gripper_xyz = layout.gripper_xyz + np.array([*self.gripper_offset_m, 0.0])
        return replace(layout, stone_xy=stone_xy, gripper_xyz=gripper_xyz)


@dataclass(frozen=True)
class Stones:
    """More stones on the board, and none of them exactly on its intersection."""

    extra: Mapping[Cell, str]  # (row, column) -> colour
    directions_rad: tuple[float, ...]  # of the shift of each stone, first those of the opening
    shift_m: float

    @classmethod
    def draw(
        cls, level: int, rng: np.random.Generator, opening: Mapping[Cell, str], target: Cell, color: str
    ) -> Self:
        directions_rad = rng.uniform(-np.pi, np.pi, BOARD.num_lines**2)
        shift_m = 1e-3 * magnitude("stones", "shift", level)
        num_extra = int(magnitude("stones", "extra", level))
        # As for the opening: the candidates do not depend on the move, the first that allows it is taken.
        while True:
            extra = _grow(opening, num_extra, rng)
            if len(extra) == num_extra and is_legal_move({**opening, **extra}, target, color):
                return cls(extra, tuple(directions_rad.tolist()), shift_m)

    def __call__(self, layout: Layout, stone: int) -> Layout:
        stone_xy, is_white = layout.stone_xy.copy(), layout.stone_is_white.copy()
        in_play = layout.stone_in_play.copy()
        for i, (cell, color) in zip(np.flatnonzero(~in_play), self.extra.items(), strict=False):
            stone_xy[i] = BOARD.intersection_xy(*cell)
            is_white[i] = color == "white"
            in_play[i] = True
        on_board = np.flatnonzero(in_play & (np.arange(len(in_play)) != stone))
        angles_rad = np.array(self.directions_rad[: len(on_board)])
        stone_xy[on_board] += self.shift_m * np.column_stack([np.cos(angles_rad), np.sin(angles_rad)])
        return replace(layout, stone_xy=stone_xy, stone_is_white=is_white, stone_in_play=in_play)


def _grow(opening: Mapping[Cell, str], num_extra: int, rng: np.random.Generator) -> dict[Cell, str]:
    """{(row, column): colour} of stones that can join the opening, alternately black and white."""
    extra: dict[Cell, str] = {}
    first = int(rng.integers(len(COLORS)))
    for place in rng.permutation(BOARD.num_lines**2):
        row, column = divmod(int(place), BOARD.num_lines)
        if len(extra) == num_extra:
            break
        grown = {**extra, (row, column): COLORS[(first + len(extra)) % len(COLORS)]}
        if (row, column) not in opening and is_legal_position({**opening, **grown}):
            extra = grown
    return extra


@dataclass(frozen=True)
class Perturbation:
    """An episode's axes at their levels; None where an axis is off."""

    levels: dict[str, int]
    table: Table | None = None
    reflectance: Reflectance | None = None
    stones: Stones | None = None
    start: Start | None = None
    photometric: Photometric | None = None
    camera: Camera | None = None
    light: Light | None = None
    language: Wording | None = None
    dynamics: Dynamics | None = None
    object: StoneLook | None = None
    goal_marker: GoalMarker | None = None

    @property
    def model_edits(self) -> tuple[ModelEdit, ...]:
        """What is done to the compiled model."""
        edits = (
            self.table,
            self.reflectance,
            self.camera,
            self.light,
            self.dynamics,
            self.object,
            self.goal_marker,
        )
        return tuple(edit for edit in edits if edit is not None)

    def arrange(self, layout: Layout, stone: int) -> Layout:
        """The layout with the stones' size, more stones and another start; `stone` is to be moved."""
        if self.object is not None:
            sizes = {"stone_radius_m": self.object.radius_m, "stone_height_m": self.object.height_m}
            layout = replace(layout, **sizes)
        for change in (self.stones, self.start):
            layout = layout if change is None else change(layout, stone)
        return layout


def draw_perturbation(
    spec: EpisodeSpec, target: Cell, color: str, opening: Mapping[Cell, str]
) -> Perturbation:
    """The axes of the spec's condition, each drawn from a generator of its own."""
    levels = {}
    for axis, low, high in Condition.parse(spec.perturbations).ranges:
        level = int(_rng(spec, LEVEL_STREAM, axis).integers(low, high + 1))
        if level > 0:
            levels[axis] = level
    draws: dict[str, Callable] = {
        "table": lambda level, rng: Table.draw(level, rng, spec.split),
        "reflectance": Reflectance.draw,
        "stones": lambda level, rng: Stones.draw(level, rng, opening, target, color),
        "start": Start.draw,
        "photometric": Photometric.draw,
        "camera": Camera.draw,
        "light": Light.draw,
        "language": lambda level, rng: Wording.draw(level, rng, target),
        "dynamics": Dynamics.draw,
        "object": StoneLook.draw,
        "goal_marker": lambda level, _: GoalMarker(level, tuple(BOARD.intersection_xy(*target).tolist())),
    }
    drawn = {axis: draws[axis](level, _rng(spec, AXIS_STREAM, axis)) for axis, level in levels.items()}
    return Perturbation(levels, **drawn)


def _rng(spec: EpisodeSpec, stream: int, axis: str) -> np.random.Generator:
    return np.random.default_rng([spec.seed, stream + list(AXES).index(axis)])
