# pyright: reportAttributeAccessIssue=false
"""Points on the surfaces of collision geometry, with their normals."""

from dataclasses import dataclass

import numpy as np

from lerobot_env_bomb.libero.stock import mujoco

SPACING_M = 0.005
MAX_ROWS = 24  # of points on a face


@dataclass(frozen=True)
class Surface:
    """Points of surfaces."""

    points: np.ndarray  # (n, 3) metres
    normals: np.ndarray  # (n, 3) unit vectors, outward


def surface_of(model: "mujoco.MjModel", data: "mujoco.MjData", geoms: np.ndarray) -> Surface:
    """Sample the surfaces of geoms that collide, in the world."""
    points, normals = [np.empty((0, 3))], [np.empty((0, 3))]
    for geom in geoms.tolist():
        if not (model.geom_contype[geom] or model.geom_conaffinity[geom]):
            continue
        local, outward = _local(model, geom)
        mat = data.geom_xmat[geom].reshape(3, 3)
        points.append(local @ mat.T + data.geom_xpos[geom])
        normals.append(outward @ mat.T)
    return Surface(np.concatenate(points), np.concatenate(normals))


def _local(model: "mujoco.MjModel", geom: int) -> tuple[np.ndarray, np.ndarray]:
    kind, size = model.geom_type[geom], model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        return _mesh(model, int(model.geom_dataid[geom]))
    if kind in (mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_CAPSULE):
        return _cylinder(float(size[0]), float(size[1]))
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return _ellipsoid(np.full(3, size[0]))
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return _ellipsoid(size)
    return _box(size) if kind == mujoco.mjtGeom.mjGEOM_BOX else (np.empty((0, 3)), np.empty((0, 3)))


def _box(half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    points, normals = [], []
    for axis in range(3):
        one, other = (axis + 1) % 3, (axis + 2) % 3
        rows = np.stack(np.meshgrid(_line(half[one]), _line(half[other]), indexing="ij"), -1).reshape(-1, 2)
        for sign in (-1, 1):
            face, normal = np.empty((len(rows), 3)), np.zeros((len(rows), 3))
            face[:, one], face[:, other], face[:, axis] = rows[:, 0], rows[:, 1], sign * half[axis]
            normal[:, axis] = sign
            points.append(face)
            normals.append(normal)
    return np.concatenate(points), np.concatenate(normals)


def _cylinder(radius: float, half: float) -> tuple[np.ndarray, np.ndarray]:
    count = int(np.clip(2 * np.pi * radius / SPACING_M, 8, 2 * MAX_ROWS))
    angles = np.arange(count) * 2 * np.pi / count
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(count)], -1)
    heights = _line(half)
    side = np.concatenate([radius * ring + [0, 0, height] for height in heights])
    return side, np.tile(ring, (len(heights), 1))


def _ellipsoid(size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    sphere, _ = _cylinder(1.0, 0.0)
    heights = np.linspace(-0.95, 0.95, 12)
    unit = np.concatenate([sphere * np.sqrt(1 - height**2) + [0, 0, height] for height in heights])
    normals = unit / size
    return unit * size, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _mesh(model: "mujoco.MjModel", mesh: int) -> tuple[np.ndarray, np.ndarray]:
    vertices = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
    faces = model.mesh_face[model.mesh_faceadr[mesh] :][: model.mesh_facenum[mesh]]
    corners = vertices[faces].astype(float)  # (n, 3, 3)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1)
    is_face = area > 1e-10
    corners, normals, area = corners[is_face], normals[is_face] / area[is_face, None], area[is_face]
    points, outward = [], []
    for triangle, normal, twice_m2 in zip(corners, normals, area, strict=True):
        rows = int(np.clip(np.sqrt(twice_m2) / SPACING_M, 1, MAX_ROWS))
        grid = [(i, j) for i in range(rows) for j in range(rows - i)]
        shares = (np.array(grid) + 1 / 3) / rows
        points.append(
            triangle[0]
            + shares[:, :1] * (triangle[1] - triangle[0])
            + shares[:, 1:] * (triangle[2] - triangle[0])
        )
        outward.append(np.tile(normal, (len(grid), 1)))
    return np.concatenate(points), np.concatenate(outward)


def _line(half: float) -> np.ndarray:
    """Points from -half to half, about `SPACING_M` apart."""
    return np.linspace(-half, half, int(np.clip(np.ceil(2 * half / SPACING_M), 1, MAX_ROWS)) + 1)
