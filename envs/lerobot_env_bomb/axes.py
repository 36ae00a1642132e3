# pyright: reportAttributeAccessIssue=false
"""What the perturbation axes do to the compiled model; see `lerobot_bomb.perturbations`.

Each transform is frozen once drawn. The level sets how far it goes, the random generator only where to,
so that the same seed at a higher level goes further the same way.
"""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from lerobot_bomb.perturbations import magnitude
from lerobot_bomb.schema import BOARD, CAMERAS, NUM_STONES
from lerobot_env_bomb.backend import ensure_gl_backend
from lerobot_env_bomb.model import (
    BOARD_HALF_SIZE_M,
    NUM_FEET,
    NUM_GLARE_RINGS,
    TABLE_PATTERNS,
    TRAY_CENTER_XY,
    TRAY_HALF_SIZE_XY,
    foot_name,
    glare_name,
    stone_name,
    table_material,
)

ensure_gl_backend()

import mujoco  # noqa: E402  (its names live in C modules that pyright cannot read)

# Neither black nor white, so that stones of both colours show on them.
TABLE_RGB = (
    (0.62, 0.30, 0.26),
    (0.66, 0.50, 0.24),
    (0.44, 0.56, 0.26),
    (0.22, 0.50, 0.48),
    (0.28, 0.36, 0.62),
    (0.50, 0.32, 0.58),
    (0.58, 0.44, 0.40),
    (0.30, 0.50, 0.34),
)
TRAY_SHARE = 0.75  # of a table's colour; under bright light a lighter tray is as white as a stone
HELDOUT_TABLE_RGB = ((0.62, 0.36, 0.48), (0.34, 0.46, 0.34))
GLARE_SPREAD_M = 0.08  # of the lamp's reflection around the board's middle, in x and in y
FRAME_MARGIN = 0.015  # of half the picture, that what must stay in view keeps from its edge
START_HEIGHT_M = 0.115  # of the gripper over the tray, which must be in view too
MAT_SHARE = 0.25  # of the stones' gloss that tray and table get
GREY = 0.5


@dataclass(frozen=True)
class Table:
    """Colour and pattern of the table, colour of the tray."""

    level: int
    table_rgb: tuple[float, float, float]
    tray_rgb: tuple[float, float, float]
    pattern: str

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator, split: str) -> Self:
        palette = {"all": TABLE_RGB + HELDOUT_TABLE_RGB, "train": TABLE_RGB, "heldout": HELDOUT_TABLE_RGB}[
            split
        ]
        table, tray = rng.choice(len(palette), size=2, replace=False)
        return cls(level, palette[table], palette[tray], TABLE_PATTERNS[rng.integers(len(TABLE_PATTERNS))])

    def __call__(self, model: mujoco.MjModel) -> None:
        share = magnitude("table", "color", self.level)
        patterned = model.material(table_material(self.pattern, self.level))
        for material, nominal, rgb in (
            (patterned, model.material("table"), np.array(self.table_rgb)),
            (model.material("mat"), model.material("mat"), TRAY_SHARE * np.array(self.tray_rgb)),
        ):
            material.rgba[:3] = (1 - share) * nominal.rgba[:3] + share * rgb
        model.geom("table").matid = patterned.id


@dataclass(frozen=True)
class Reflectance:
    """Gloss of stones, tray and table, and a lamp's reflection on the board."""

    level: int
    glare_xy: tuple[float, float]  # metres

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator) -> Self:
        x, y = rng.uniform(-GLARE_SPREAD_M, GLARE_SPREAD_M, 2)
        return cls(level, (float(x), float(y)))

    def __call__(self, model: mujoco.MjModel) -> None:
        gloss = magnitude("reflectance", "gloss", self.level)
        # a tray as glossy as the stones would be as white as they are
        for name, share in (("stone", 1.0), ("mat", MAT_SHARE), ("table", MAT_SHARE)):
            material = model.material(name)
            material.specular = material.specular[0] + share * gloss
            material.shininess = (1 - gloss) * material.shininess[0]
        model.light("key").specular[:] += gloss
        # several discs of growing size, each as transparent, make one with a soft edge
        opacity = 1 - (1 - magnitude("reflectance", "glare", self.level)) ** (1 / NUM_GLARE_RINGS)
        for ring in range(NUM_GLARE_RINGS):
            geom = model.geom(glare_name(ring))
            geom.pos[:2] = self.glare_xy
            geom.rgba[3] = opacity


@dataclass(frozen=True)
class Light:
    """Intensity and direction of the light."""

    factor: float
    axis: tuple[float, float, float]  # that the lamp's direction turns around
    angle_rad: float

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator) -> Self:
        factor = magnitude("light", ("dim", "bright")[rng.integers(2)], level)
        azimuth_rad = rng.uniform(-np.pi, np.pi)
        axis = (float(np.cos(azimuth_rad)), float(np.sin(azimuth_rad)), 0.0)
        return cls(factor, axis, float(np.radians(magnitude("light", "tilt", level))))

    def __call__(self, model: mujoco.MjModel) -> None:
        lamp, headlight = model.light("key"), model.vis.headlight
        for part in (lamp.diffuse, lamp.specular, headlight.ambient, headlight.diffuse):
            part[:] *= self.factor
        lamp.dir[:] = _rotation(np.array(self.axis), self.angle_rad) @ lamp.dir


@dataclass(frozen=True)
class Camera:
    """Pose and field of view of both cameras; the workspace camera keeps board and tray in view."""

    angle_rad: float
    wrist_angle_rad: float
    direction_rad: float  # in the picture, that the cameras swing to
    fov_factor: float
    distance_factor: float

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator) -> Self:
        signs = rng.choice((-1.0, 1.0), 2)
        return cls(
            angle_rad=float(np.radians(magnitude("camera", "angle", level))),
            wrist_angle_rad=float(np.radians(magnitude("camera", "wrist_angle", level))),
            direction_rad=float(rng.uniform(-np.pi, np.pi)),
            fov_factor=1 + float(signs[0]) * magnitude("camera", "fov", level),
            distance_factor=1 + float(signs[1]) * magnitude("camera", "distance", level),
        )

    def __call__(self, model: mujoco.MjModel) -> None:
        workspace, wrist = (model.camera(name) for name in CAMERAS)
        for camera in (workspace, wrist):
            camera.fovy *= self.fov_factor
        self._swing(wrist, model.site("grip").pos, self.wrist_angle_rad)  # of the same body
        backward = _matrix(workspace.quat)[:, 2]
        pivot = workspace.pos - backward * workspace.pos[2] / backward[2]  # where it looks on the table
        distance_m = np.linalg.norm(workspace.pos - pivot) * self.distance_factor
        self._swing(workspace, pivot, self.angle_rad)
        camera_from_world = _matrix(workspace.quat).T
        distance_m = max(distance_m, _least_distance(camera_from_world, pivot, workspace.fovy[0]))
        workspace.pos[:] = pivot + distance_m * camera_from_world[2]

    def _swing(self, camera: Any, pivot: np.ndarray, angle_rad: float) -> None:
        """Turn a named camera's pose around a point of its body's frame."""
        matrix = _matrix(camera.quat)
        axis = np.cos(self.direction_rad) * matrix[:, 0] + np.sin(self.direction_rad) * matrix[:, 1]
        turn = _rotation(axis, angle_rad)
        camera.pos[:] = pivot + turn @ (camera.pos - pivot)
        mujoco.mju_mat2Quat(camera.quat, (turn @ matrix).ravel())


def _least_distance(camera_from_world: np.ndarray, pivot: np.ndarray, fovy_deg: float) -> float:
    """Metres from the pivot at which a square picture shows board, tray and the gripper over the tray."""
    signs = np.array([(x, y) for x in (-1, 1) for y in (-1, 1)])
    board = _at_height(signs * BOARD_HALF_SIZE_M, BOARD.thickness_m)
    tray = _at_height(TRAY_CENTER_XY + signs * TRAY_HALF_SIZE_XY, BOARD.thickness_m)
    gripper = _at_height(TRAY_CENTER_XY + signs * TRAY_HALF_SIZE_XY[0], START_HEIGHT_M)
    right, up, backward = camera_from_world @ (np.concatenate([board, tray, gripper]) - pivot).T
    slope = np.tan(np.radians(fovy_deg) / 2) * (1 - FRAME_MARGIN)
    return float(np.max(backward + np.maximum(abs(right), abs(up)) / slope))


def _at_height(xy: np.ndarray, height_m: float) -> np.ndarray:
    """(n, 2) -> (n, 3) metres."""
    return np.column_stack([xy, np.full(len(xy), height_m)])


@dataclass(frozen=True)
class StoneLook:
    """Size, shape and shade of all stones. The sizes are the layout's."""

    level: int
    radius_m: float
    height_m: float

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator) -> Self:
        signs = rng.choice((-1.0, 1.0), 2)
        return cls(
            level,
            radius_m=BOARD.stone_radius_m + 1e-3 * float(signs[0]) * magnitude("object", "radius", level),
            height_m=BOARD.stone_height_m + 1e-3 * float(signs[1]) * magnitude("object", "height", level),
        )

    def __call__(self, model: mujoco.MjModel) -> None:
        radius, half = self.radius_m, self.height_m / 2
        growth = max(1.0, radius / BOARD.stone_radius_m, self.height_m / BOARD.stone_height_m)
        shade = magnitude("object", "shade", self.level)
        for i in range(NUM_STONES):
            name = stone_name(i)
            rim, visual, body = model.geom(name), model.geom(f"{name}_visual"), model.body(name)
            rim.size[:2] = radius, half
            feet = [model.geom(foot_name(i, k)) for k in range(NUM_FEET)]
            for foot in feet:
                foot.size[0] = half
                foot.pos[:2] *= (radius - half) / np.linalg.norm(foot.pos[:2])
            # bounds that collision detection looks at first; too wide does no harm
            for geom in (rim, *feet):
                geom.rbound *= growth
                model.geom_aabb[geom.id] *= growth
            first, count = model.body_bvhadr[body.id], model.body_bvhnum[body.id]
            model.bvh_aabb[first : first + count] *= growth
            if magnitude("object", "flat", self.level):
                visual.type = mujoco.mjtGeom.mjGEOM_CYLINDER
                visual.size[:2] = radius, half
            else:
                visual.size[:] = radius, radius, half
            visual.rgba[:3] = (1 - shade) * visual.rgba[:3] + shade * GREY


@dataclass(frozen=True)
class Dynamics:
    """Mass and friction of the stones; noise and latency of the arm."""

    mass_factor: float
    friction_factor: float
    noise: float  # standard deviation on executed x, y, z in units of the largest step
    latency: int  # control steps

    @classmethod
    def draw(cls, level: int, rng: np.random.Generator) -> Self:
        heavy, rough = rng.choice((-1.0, 1.0), 2)
        return cls(
            mass_factor=float(magnitude("dynamics", "mass", level) ** heavy),
            friction_factor=float(magnitude("dynamics", "friction", level) ** rough),
            noise=magnitude("dynamics", "noise", level),
            latency=int(magnitude("dynamics", "latency", level)),
        )

    def __call__(self, model: mujoco.MjModel) -> None:
        bodies = [model.body(stone_name(i)).id for i in range(NUM_STONES)]
        dofs = np.isin(model.dof_bodyid, bodies)
        geoms = np.isin(model.geom_bodyid, bodies)
        for values in (model.body_mass, model.body_inertia, model.body_subtreemass):
            values[bodies] *= self.mass_factor
        model.body_invweight0[bodies] /= self.mass_factor
        model.dof_invweight0[dofs] /= self.mass_factor
        model.geom_friction[geoms] *= self.friction_factor


@dataclass(frozen=True)
class GoalMarker:
    """A blue dot on the target."""

    level: int
    target_xy: tuple[float, float]  # metres

    def __call__(self, model: mujoco.MjModel) -> None:
        geom = model.geom("goal_marker")
        geom.pos[:2] = self.target_xy
        geom.size[0] = 1e-3 * magnitude("goal_marker", "radius", self.level)
        geom.rgba[3] = 1.0


def _rotation(axis: np.ndarray, angle_rad: float) -> np.ndarray:
    """(3, 3) rotation around a unit axis."""
    quat, matrix = np.empty(4), np.empty(9)
    mujoco.mju_axisAngle2Quat(quat, axis, angle_rad)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def _matrix(quat: np.ndarray) -> np.ndarray:
    """(3, 3) rotation of a quaternion."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)
