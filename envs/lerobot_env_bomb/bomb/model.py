# pyright: reportAttributeAccessIssue=false, reportInvalidTypeForm=false
"""Builds BOMB's one MjModel: a robot's scene plus board and stones in the sizes of `BOARD`."""

from collections.abc import Mapping
from functools import cache

import numpy as np

from lerobot_bomb.bomb.board import (
    BOARD,
    NUM_STONES,
    PATTERN_CENTER_XY,
    PATTERN_HALF_SIZE_M,
    PATTERN_PITCH_M,
    TRAY_CENTER_XY,
    TRAY_HALF_SIZE_XY,
    Intersection,
)
from lerobot_bomb.bomb.perturbations import magnitude
from lerobot_bomb.conditions import MAX_LEVEL
from lerobot_env_bomb.bomb.robots import Robot
from lerobot_env_bomb.shared.mujoco_gl import mujoco

# How deep board and tray reach into the table: a stone that is pressed into them comes out at the top.
SUNK_M = 0.05

PARKED_XYZ = (1.0, 1.0, -0.5)  # metres, below the table: where stones wait that an episode does not use
PARKED_SPACING_M = 0.05

# N m s/rad. Stops within a second a stone that rolls or spins on its rim; too little to slow a flight.
STONE_DAMPING = 3e-6

NUM_FEET = 4  # balls that a stone stands on

WOOD_RGB = (216, 168, 104)
LINE_RGB = (46, 30, 16)
LINE_WIDTH_M = 0.0020
STAR_POINT_RADIUS_M = 0.0036
TEXTURE_SIZE = 512  # pixels

TABLE_PATTERNS = ("stripes", "checks", "speckles")  # of the axis `table`, each at every level
PATTERN_SIZE = 64  # pixels of a tile
PATTERN_TILE_M = 0.16  # a tile's edge on the table
NUM_GLARE_RINGS = 2  # transparent discs that make a lamp's reflection on the board
GLARE_RADIUS_M = 0.055  # of the largest
GLARE_HEIGHT_M = 2e-4
GOAL_MARKER_RGB = (0.10, 0.35, 0.95)
PATTERN_THICKNESS_M = 0.002
PATTERN_LINE_WIDTH_M = 0.0010
PATTERN_STONE_HEIGHT_M = 0.0005
MAX_PATTERN_STONES = 4
STONE_RGBA = {True: (0.96, 0.96, 0.93, 1.0), False: (0.06, 0.06, 0.07, 1.0)}  # by "is white"
HIDDEN = 0.0  # opacity of geoms that only a perturbation or a pattern shows


def scene_spec(robot: Robot) -> mujoco.MjSpec:
    """Describe the scene, with textures that are still to be painted."""
    spec = robot.load()
    _add_board(spec)
    _add_tray(spec)
    _add_table_patterns(spec)
    _add_marks(spec)
    _add_pattern(spec)
    for index in range(NUM_STONES):
        _add_stone(spec, index)
    return spec


def compile_scene(robot: Robot) -> mujoco.MjModel:
    """Compile the scene; every episode reuses the result."""
    model = scene_spec(robot).compile()
    # Painted after compilation: handing the pixels to MjSpec one by one takes a second.
    _paint(model, "board", board_texture())
    for pattern in TABLE_PATTERNS:
        for level in range(1, MAX_LEVEL + 1):
            _paint(model, table_material(pattern, level), pattern_texture(pattern, level))
    return model


def _paint(model: mujoco.MjModel, texture: str, image: np.ndarray) -> None:
    start = model.texture(texture).adr[0]
    model.tex_data[start : start + image.size] = image.ravel()


def stone_name(index: int) -> str:
    """Name of body, joint and rim geom of a stone."""
    return f"stone_{index}"


def pattern_stone_name(index: int) -> str:
    """Name of a stone on the small board."""
    return f"pattern_stone_{index}"


def foot_name(index: int, foot: int) -> str:
    """Name of one of the balls under a stone."""
    return f"{stone_name(index)}_foot_{foot}"


def table_material(pattern: str, level: int) -> str:
    """Name of material and texture of the table's pattern at a level of the axis `table`."""
    return f"table_{pattern}_{level}"


def glare_name(ring: int) -> str:
    """Name of a disc of the lamp's reflection."""
    return f"glare_{ring}"


def parked_xyz(index: int) -> np.ndarray:
    """(3,) metres, where stone `index` waits while it is not in play."""
    return np.array(PARKED_XYZ) + np.array([index * PARKED_SPACING_M, 0, 0])


@cache
def board_texture() -> np.ndarray:
    """(TEXTURE_SIZE, TEXTURE_SIZE, 3) uint8 image of the board: wood, grid lines, star point."""
    metres = (np.arange(TEXTURE_SIZE) + 0.5) / TEXTURE_SIZE * 2 * BOARD.half_size_m - BOARD.half_size_m
    x, y = np.meshgrid(metres, metres)
    grain = 0.5 * np.sin(300 * y + 1.5 * np.sin(25 * x) + 6 * np.sin(17 * y)) + 0.5 * np.sin(
        900 * y + 2 * np.sin(13 * x + 40 * y)
    )
    wood = np.array(WOOD_RGB) * (1 + 0.035 * grain[..., None])
    pixel_m = 2 * BOARD.half_size_m / TEXTURE_SIZE
    ink = np.zeros_like(x)
    middle = (BOARD.num_lines - 1) / 2
    reach = middle * BOARD.pitch_m + LINE_WIDTH_M / 2
    for line in range(BOARD.num_lines):
        place = (line - middle) * BOARD.pitch_m
        for across, along in ((x, y), (y, x)):
            ink = np.maximum(
                ink, _coverage(LINE_WIDTH_M / 2 - abs(across - place), pixel_m) * (abs(along) <= reach)
            )
    ink = np.maximum(ink, _coverage(STAR_POINT_RADIUS_M - np.hypot(x, y), pixel_m))[..., None]
    return np.clip((1 - ink) * wood + ink * np.array(LINE_RGB), 0, 255).astype(np.uint8)


def pattern_texture(pattern: str, level: int) -> np.ndarray:
    """(PATTERN_SIZE, PATTERN_SIZE, 3) uint8 tile that darkens the table by up to the level's contrast."""
    i, j = np.indices((PATTERN_SIZE, PATTERN_SIZE)) * 4 // PATTERN_SIZE
    darkness = {
        "stripes": i % 2,
        "checks": (i + j) % 2,
        "speckles": np.random.default_rng(0).random((PATTERN_SIZE // 2,) * 2).repeat(2, 0).repeat(2, 1) ** 2,
    }[pattern]
    tile = 255 * (1 - magnitude("table", "pattern", level) * darkness)
    return np.repeat(tile[..., None], 3, axis=2).astype(np.uint8)


def _coverage(inside_m: np.ndarray, pixel_m: float) -> np.ndarray:
    """Share of a pixel in [0, 1] that lies inside a shape, from the distance to its edge."""
    return np.clip(inside_m / pixel_m + 0.5, 0, 1)


def _add_board(spec: mujoco.MjSpec) -> None:
    half = BOARD.half_size_m
    spec.add_texture(
        name="board",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        width=TEXTURE_SIZE,
        height=TEXTURE_SIZE,
        nchannel=3,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
    )
    material = spec.add_material(name="board", specular=0.1, shininess=0.1)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "board"
    spec.worldbody.add_geom(
        spec.find_default("support"),
        name="board",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[half, half, (BOARD.thickness_m + SUNK_M) / 2],
        pos=[0, 0, (BOARD.thickness_m - SUNK_M) / 2],
        rgba=[*(np.array(WOOD_RGB) / 255 * 0.8), 1],
    )
    # The drawn surface floats a tenth of a millimetre above the wood so that the two do not flicker.
    spec.worldbody.add_geom(
        name="board_surface",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[half, half, 0.1],
        pos=[0, 0, BOARD.thickness_m + 1e-4],
        material="board",
        contype=0,
        conaffinity=0,
    )


def _add_tray(spec: mujoco.MjSpec) -> None:
    spec.worldbody.add_geom(
        spec.find_default("support"),
        name="tray",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[*TRAY_HALF_SIZE_XY, (BOARD.thickness_m + SUNK_M) / 2],
        pos=[*TRAY_CENTER_XY, (BOARD.thickness_m - SUNK_M) / 2],
        material="mat",
    )


def _add_table_patterns(spec: mujoco.MjSpec) -> None:
    for pattern in TABLE_PATTERNS:
        for level in range(1, MAX_LEVEL + 1):
            name = table_material(pattern, level)
            spec.add_texture(
                name=name,
                type=mujoco.mjtTexture.mjTEXTURE_2D,
                width=PATTERN_SIZE,
                height=PATTERN_SIZE,
                nchannel=3,
                builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
            )
            material = spec.add_material(
                name=name,
                specular=0.1,
                shininess=0.1,
                texuniform=True,
                texrepeat=[1 / PATTERN_TILE_M, 1 / PATTERN_TILE_M],
            )
            material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name


def _add_marks(spec: mujoco.MjSpec) -> None:
    """Add the marks on the board's surface, hidden unless an axis shows them: a lamp's reflection, a dot."""
    surface_m = BOARD.thickness_m + GLARE_HEIGHT_M
    for ring in range(NUM_GLARE_RINGS):
        radius_m = GLARE_RADIUS_M * (ring + 1) / NUM_GLARE_RINGS
        _add_disc(spec, glare_name(ring), radius_m, surface_m, (1, 1, 1, HIDDEN))
    _add_disc(spec, "goal_marker", STAR_POINT_RADIUS_M, surface_m, (*GOAL_MARKER_RGB, HIDDEN))


def _add_pattern(spec: mujoco.MjSpec) -> None:
    """Add the small board in the tray, hidden unless an episode shows a pattern on it."""
    half, height_m = PATTERN_HALF_SIZE_M, BOARD.thickness_m + PATTERN_THICKNESS_M
    spec.worldbody.add_geom(
        spec.find_default("visual"),
        name="pattern_board",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[half, half, PATTERN_THICKNESS_M / 2],
        pos=[*PATTERN_CENTER_XY, height_m - PATTERN_THICKNESS_M / 2],
        rgba=[*(np.array(WOOD_RGB) / 255), HIDDEN],
    )
    middle = (BOARD.num_lines - 1) / 2
    reach_m = middle * PATTERN_PITCH_M
    for line in range(BOARD.num_lines):
        for axis in range(2):
            center = np.array(PATTERN_CENTER_XY)
            center[axis] += (line - middle) * PATTERN_PITCH_M
            size = [reach_m, reach_m, 1e-4]
            size[axis] = PATTERN_LINE_WIDTH_M / 2
            spec.worldbody.add_geom(
                spec.find_default("visual"),
                name=f"pattern_line_{axis}_{line}",
                type=mujoco.mjtGeom.mjGEOM_BOX,
                size=size,
                pos=[*center, height_m],
                rgba=[*(np.array(LINE_RGB) / 255), HIDDEN],
            )
    for index in range(MAX_PATTERN_STONES):
        name, radius_m = pattern_stone_name(index), PATTERN_PITCH_M * BOARD.stone_radius_m / BOARD.pitch_m
        _add_disc(spec, name, 1.4 * radius_m, height_m + PATTERN_STONE_HEIGHT_M, (0, 0, 0, HIDDEN))


def show_pattern(model: mujoco.MjModel, stones: Mapping[Intersection, str]) -> None:
    """Show the small board with these stones on it."""
    for geom in range(model.ngeom):
        if model.geom(geom).name.startswith(("pattern_board", "pattern_line")):
            model.geom_rgba[geom, 3] = 1.0
    for index, (intersection, color) in enumerate(stones.items()):
        geom = model.geom(pattern_stone_name(index))
        offset = BOARD.intersection_xy(*intersection) * PATTERN_PITCH_M / BOARD.pitch_m
        geom.pos[:2] = np.array(PATTERN_CENTER_XY) + offset
        geom.rgba[:] = STONE_RGBA[color == "white"]


def _add_disc(spec: mujoco.MjSpec, name: str, radius_m: float, height_m: float, rgba: tuple) -> None:
    spec.worldbody.add_geom(
        spec.find_default("visual"),
        name=name,
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[radius_m, 1e-4, 0],
        pos=[0, 0, height_m],
        rgba=rgba,
    )


def _add_stone(spec: mujoco.MjSpec, index: int) -> None:
    name = stone_name(index)
    radius, half_height = BOARD.stone_radius_m, BOARD.stone_height_m / 2
    body = spec.worldbody.add_body(name=name, pos=parked_xyz(index))
    body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_FREE, damping=STONE_DAMPING)
    body.add_geom(spec.find_default("rim"), name=name, size=[radius, half_height, 0])
    # A stone stands on balls in its rim: contact of balls with boxes is exact, while contact of a flat
    # cylinder with a flat box, found by search, lets a stone come to rest a millimetre inside the board.
    for foot in range(NUM_FEET):
        angle_rad = 2 * np.pi * (foot + 0.5) / NUM_FEET
        center = (radius - half_height) * np.array([np.cos(angle_rad), np.sin(angle_rad)])
        body.add_geom(
            spec.find_default("foot"), name=foot_name(index, foot), size=[half_height, 0, 0], pos=[*center, 0]
        )
    body.add_geom(
        spec.find_default("visual"),
        name=f"{name}_visual",
        type=mujoco.mjtGeom.mjGEOM_ELLIPSOID,
        size=[radius, radius, half_height],
        material="stone",
    )
