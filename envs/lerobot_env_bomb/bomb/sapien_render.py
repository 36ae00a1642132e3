# pyright: reportAttributeAccessIssue=false, reportInvalidTypeForm=false
"""Images of BOMB's scene by SAPIEN's renderer, on Vulkan: other pixels of the same states.

MuJoCo's model is what is drawn: its shapes, materials, textures, lamps and cameras, as the axes have edited
them. Where the two differ:

- Materials are physically based: roughness is 1 - shininess, light adds up before it becomes a grey level.
- The headlight's diffuse part shines along the camera's axis, without a gloss.
- MuJoCo's grey levels are proportional to light. Here light is scaled so that a surface that all lamps face
  has MuJoCo's grey level, however strong the axis `light` makes them.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import sapien
from sapien import Pose, physx, render

from lerobot_env_bomb.bomb.render import begin_drawing
from lerobot_env_bomb.bomb.sapien_physics import X_TO_Z
from lerobot_env_bomb.bomb.scene import EDITABLE
from lerobot_env_bomb.shared.mujoco_gl import mujoco
from lerobot_env_bomb.shared.rotations import quaternion_of

SHADER = "default"
SHOWN_GROUPS = 3  # of geoms; MuJoCo hides the others
SPHERE_STEPS = 24  # of an ellipsoid's mesh around its axis
MIPMAPS = 5
# what a drawing depends on, beside poses and cameras
LOOK = [name for name in EDITABLE if name.startswith(("geom_", "mat_", "light_"))]


class SapienRenderer:
    """Draws a model's fixed cameras as `CameraRenderer` does.

    Raises:
        ValueError: there is no Vulkan driver that SAPIEN can use.
    """

    opengl_vendor = "Vulkan"

    def __init__(self, model: mujoco.MjModel):
        self._model = model
        begin_drawing()
        render.set_camera_shader_dir(SHADER)
        self.opengl_renderer = device_name()
        _device()
        self._look = b""  # of the scene as it was built

    def draw(self, data: mujoco.MjData, camera: str, size: int) -> np.ndarray:
        return _rgb(self._picture(data, camera, size))

    def draw_depth(self, data: mujoco.MjData, camera: str, size: int) -> tuple[np.ndarray, np.ndarray]:
        picture = self._picture(data, camera, size)
        return _rgb(picture), -picture.get_picture("Position")[..., 2].astype(np.float32)

    def draw_geoms(self, data: mujoco.MjData, camera: str, size: int) -> np.ndarray:
        shown = self._picture(data, camera, size).get_picture("Segmentation")[..., 1]
        geoms = np.full(max(self._geoms) + 1, -1, dtype=np.int32)
        geoms[list(self._geoms)] = list(self._geoms.values())
        return geoms[shown]

    def close(self) -> None:
        """Free the scene."""
        self._look, self._scene = b"", None
        self._cameras, self._entities = {}, {}

    def _picture(self, data: mujoco.MjData, camera: str, size: int) -> Any:
        """Take a picture; return SAPIEN's camera, which holds it."""
        look = b"".join(getattr(self._model, name).tobytes() for name in LOOK)
        headlight = self._model.vis.headlight
        look += headlight.ambient.tobytes() + headlight.diffuse.tobytes()
        if look != self._look:
            self._build()
            self._look = look
        poses = np.hstack([data.geom_xpos, data.geom_xmat])
        has_moved = (poses != self._poses).any(axis=1)
        self._poses = poses
        for geom, entity in self._entities.items():
            if has_moved[geom]:
                entity.set_pose(Pose(data.geom_xpos[geom], quaternion_of(data.geom_xmat[geom])))
        if size not in self._cameras:
            self._cameras[size] = self._add_camera(size)
        taken, seen = self._cameras[size], data.camera(camera)
        taken.set_fovy(float(np.deg2rad(self._model.camera(camera).fovy[0])))
        right, up, back = seen.xmat.reshape(3, 3).T
        # SAPIEN's cameras look along x, y points left and z up
        pose = Pose(seen.xpos, quaternion_of(np.column_stack([-back, -right, up])))
        taken.entity.set_pose(pose)
        self._headlight.set_pose(pose)
        self._scene.update_render()
        taken.take_picture()
        return taken

    def _build(self) -> None:
        """Make the scene anew, with the model's present look."""
        model = self._model
        self._scene: Any = sapien.Scene([physx.PhysxCpuSystem(), render.RenderSystem()])
        self._cameras: dict[int, Any] = {}
        self._entities: dict[int, Any] = {}
        self._poses = np.full((model.ngeom, 12), np.nan)
        for geom in range(model.ngeom):
            rgba = self._rgba(geom)
            if rgba[3] == 0 or model.geom_group[geom] >= SHOWN_GROUPS:
                continue
            body = render.RenderBodyComponent()
            body.attach(SHAPES[model.geom_type[geom]](model, geom, self._material(geom, rgba)))
            entity = sapien.Entity()
            entity.add_component(body)
            self._scene.add_entity(entity)
            self._entities[geom] = entity
        self._geoms = {0: -1} | {entity.per_scene_id: geom for geom, entity in self._entities.items()}
        self._add_lights()

    def _add_lights(self) -> None:
        model, headlight = self._model, self._model.vis.headlight
        lamps = model.light_diffuse.sum(axis=0) + headlight.diffuse
        gain = _linear(headlight.ambient + lamps) / (headlight.ambient + lamps)
        self._scene.set_ambient_light(gain * headlight.ambient)
        for direction, diffuse in zip(model.light_dir, model.light_diffuse, strict=True):
            # a lamp of strength pi lights a surface that faces it as an ambient light of 1
            self._scene.add_directional_light(direction, np.pi * gain * diffuse)
        light = render.RenderDirectionalLightComponent()
        light.set_color(np.pi * gain * headlight.diffuse)
        self._headlight = sapien.Entity()
        self._headlight.add_component(light)
        self._scene.add_entity(self._headlight)

    def _add_camera(self, size: int) -> Any:
        planes, extent_m = self._model.vis.map, self._model.stat.extent
        near_m, far_m = float(planes.znear * extent_m), float(planes.zfar * extent_m)
        return self._scene.add_camera(f"{size}", size, size, 1.0, near_m, far_m)

    def _rgba(self, geom: int) -> np.ndarray:
        """(4,) colour of a geom; the material's unless the geom has one of its own."""
        own, material = self._model.geom_rgba[geom], self._model.geom_matid[geom]
        is_default = material >= 0 and np.array_equal(own, [0.5, 0.5, 0.5, 1.0])
        return (self._model.mat_rgba[material] if is_default else own).astype(np.float64)

    def _material(self, geom: int, rgba: np.ndarray) -> Any:
        model, number = self._model, self._model.geom_matid[geom]
        made = render.RenderMaterial(base_color=[*_linear(rgba[:3]), rgba[3]])
        if number < 0:
            return made
        made.specular = min(float(model.mat_specular[number]), 1.0)
        made.roughness = float(1 - model.mat_shininess[number])
        made.emission = [*_linear(rgba[:3] * model.mat_emission[number]), 1.0]
        texture = int(model.mat_texid[number, mujoco.mjtTextureRole.mjTEXROLE_RGB])
        if texture >= 0:
            made.base_color_texture = self._texture(texture, rgba)
        return made

    def _texture(self, number: int, rgba: np.ndarray) -> Any:
        """Return a texture in a material's colour, which SAPIEN would leave out."""
        model = self._model
        start, height, width = model.tex_adr[number], model.tex_height[number], model.tex_width[number]
        image = model.tex_data[start : start + 3 * height * width].reshape(height, width, 3)
        pixels = np.full((height, width, 4), 255, dtype=np.uint8)
        pixels[..., :3] = np.round(image * rgba[:3])
        return render.RenderTexture2D(pixels, "R8G8B8A8Unorm", MIPMAPS, srgb=True)


@cache
def _device() -> render.RenderSystem:
    """Keep SAPIEN's device: without it, each renderer of a process would compile the shaders, for 7 s."""
    return render.RenderSystem()


def device_name() -> str:
    """Return the name of the device that draws.

    Raises:
        ValueError: there is no Vulkan driver that SAPIEN can use.
    """
    try:
        return render.get_device_summary().splitlines()[0].removeprefix("GPU: ")
    except RuntimeError as error:
        raise ValueError(
            f"SAPIEN cannot draw ({error}): it needs a Vulkan driver, on a CPU Mesa's lavapipe 24.3 or newer "
            "(VK_ICD_FILENAMES names its file)"
        ) from error


def _linear(levels: np.ndarray) -> np.ndarray:
    """Return the light that makes these grey levels on a screen, both from 0 to 1 (IEC 61966-2-1)."""
    return np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)


def _rgb(camera: Any) -> np.ndarray:
    return np.round(255 * np.clip(camera.get_picture("Color")[..., :3], 0, 1)).astype(np.uint8)


def _box(model: mujoco.MjModel, geom: int, material: Any) -> Any:
    return render.RenderShapeBox(model.geom_size[geom].tolist(), material)


def _sphere(model: mujoco.MjModel, geom: int, material: Any) -> Any:
    return render.RenderShapeSphere(float(model.geom_size[geom, 0]), material)


def _along_z(shape: Callable[..., Any]) -> Callable[..., Any]:
    def make(model: mujoco.MjModel, geom: int, material: Any) -> Any:
        radius, half_length = map(float, model.geom_size[geom, :2])
        made = shape(radius, half_length, material)
        made.local_pose = Pose(q=X_TO_Z)
        return made

    return make


def _ellipsoid(model: mujoco.MjModel, geom: int, material: Any) -> Any:
    angles = np.linspace(0, np.pi, SPHERE_STEPS // 2 + 1), np.linspace(0, 2 * np.pi, SPHERE_STEPS + 1)
    polar, around = np.meshgrid(*angles, indexing="ij")
    unit = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], axis=-1)
    corner = np.arange(unit[..., 0].size).reshape(polar.shape)
    above, next_above, below, next_below = corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]
    faces = np.concatenate(
        [np.stack([above, below, next_above], axis=-1), np.stack([below, next_below, next_above], axis=-1)]
    )
    normals = unit / model.geom_size[geom]
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return _mesh(unit * model.geom_size[geom], faces, normals, material)


def _plane(model: mujoco.MjModel, geom: int, material: Any) -> Any:
    half_x, half_y = model.geom_size[geom, :2]
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    number = model.geom_matid[geom]
    is_uniform = number >= 0 and model.mat_texuniform[number]
    scale = [half_x, half_y] * model.mat_texrepeat[number] if is_uniform else np.array([0.5, 0.5])
    points = np.column_stack([corners * [half_x, half_y], np.zeros(4)])
    places = corners * scale if is_uniform else corners * scale + 0.5
    return _mesh(points, np.array([[0, 1, 2], [0, 2, 3]]), np.tile([0, 0, 1], (4, 1)), material, places)


def _triangles(model: mujoco.MjModel, geom: int, material: Any) -> Any:
    """Return a mesh of the model with flat faces."""
    number = model.geom_dataid[geom]
    start, first = model.mesh_vertadr[number], model.mesh_faceadr[number]
    points = model.mesh_vert[start : start + model.mesh_vertnum[number]]
    corners = points[model.mesh_face[first : first + model.mesh_facenum[number]]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12
    return _mesh(corners, np.arange(3 * len(corners)), normals.repeat(3, axis=0), material)


def _mesh(
    points: np.ndarray,
    faces: np.ndarray,
    normals: np.ndarray,
    material: Any,
    places: np.ndarray | None = None,
) -> Any:
    """Return a mesh; `places`: of its points in the texture."""
    points = points.reshape(-1, 3)
    return render.RenderShapeTriangleMesh(
        points.astype(np.float32),
        faces.reshape(-1, 3).astype(np.uint32),
        normals.reshape(-1, 3).astype(np.float32),
        (np.zeros((len(points), 2)) if places is None else places).astype(np.float32),
        material,
    )


SHAPES: dict[int, Callable[..., Any]] = {
    mujoco.mjtGeom.mjGEOM_PLANE: _plane,
    mujoco.mjtGeom.mjGEOM_SPHERE: _sphere,
    mujoco.mjtGeom.mjGEOM_CAPSULE: _along_z(render.RenderShapeCapsule),
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: _ellipsoid,
    mujoco.mjtGeom.mjGEOM_CYLINDER: _along_z(render.RenderShapeCylinder),
    mujoco.mjtGeom.mjGEOM_BOX: _box,
    mujoco.mjtGeom.mjGEOM_MESH: _triangles,
}
