# pyright: reportAttributeAccessIssue=false, reportInvalidTypeForm=false
"""Images of BOMB's scene, fast enough for training data without a GPU."""

import atexit
import ctypes
import os
import threading
import weakref
from typing import Any, Protocol

import numpy as np
from OpenGL.raw.GL.VERSION import GL_1_0

from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_env_bomb.bomb.simulators import import_with_sapien
from lerobot_env_bomb.shared.mujoco_gl import GLContext, mujoco

SHADOW_MAP_SIZE = 512  # pixels
CAPTION_LINE_PX, CAPTION_MARGIN_PX = 26, 10
CAPTION_SCALE = 0.55  # of the typeface
CAPTION_BACKGROUND = 40  # grey level

_drawing_process: int | None = None  # the one that made the first renderer; forks inherit the number


def check_process() -> None:
    """Raise a RuntimeError in a process that was forked after a renderer had been made: it would hang."""
    if _drawing_process not in (None, os.getpid()):
        raise RuntimeError(
            f"process {os.getpid()} was forked after process {_drawing_process} had rendered; OpenGL does "
            "not survive a fork and would hang. Start worker processes with the method forkserver or spawn: "
            "gymnasium.vector.AsyncVectorEnv(..., context='forkserver')"
        )


def begin_drawing() -> None:
    """Note that this process draws, so that none is forked from it.

    Raises:
        RuntimeError: it was forked from one that draws.
    """
    check_process()
    global _drawing_process
    _drawing_process = os.getpid()


class _Owner:
    """The process and the thread to which an OpenGL context belongs."""

    def __init__(self) -> None:
        self._process, self._thread = os.getpid(), threading.current_thread()

    def is_here(self) -> bool:
        return self._process == os.getpid() and self._thread is threading.current_thread()

    def check(self) -> None:
        """Raise a RuntimeError in another process or thread."""
        check_process()
        if not self.is_here():
            raise RuntimeError(
                f"this environment draws in thread {self._thread.name!r}, where it was first reset, and "
                f"cannot be stepped, rendered or closed in {threading.current_thread().name!r}: OpenGL binds "
                "it to one thread. Use it there alone, or give each thread an environment of its own"
            )


class Renderer(Protocol):
    """Draws a model's fixed cameras."""

    opengl_vendor: str | None
    opengl_renderer: str | None

    def draw(self, data: mujoco.MjData, camera: str, size: int) -> np.ndarray:
        """(size, size, 3) uint8 image of a named camera."""
        ...

    def draw_depth(self, data: mujoco.MjData, camera: str, size: int) -> tuple[np.ndarray, np.ndarray]:
        """Draw the image, and (size, size) float32 metres along the optical axis to what it shows."""
        ...

    def draw_geoms(self, data: mujoco.MjData, camera: str, size: int) -> np.ndarray:
        """(size, size) int32, the geom that each pixel of the image shows; -1: none."""
        ...

    def close(self) -> None:
        """Free what draws."""
        ...


def renderer_of(model: mujoco.MjModel, options: RenderOptions, max_size: int) -> Renderer:
    """Return what draws a model with these options, at any size up to `max_size` pixels.

    Raises:
        ValueError: SAPIEN is to draw and cannot.
    """
    if options.preset != "sapien":
        return CameraRenderer(model, options, max_size)
    return import_with_sapien("sapien_render").SapienRenderer(model)


class CameraRenderer:
    """One OpenGL context that draws a model's fixed cameras at any size up to `max_size` pixels."""

    def __init__(self, model: mujoco.MjModel, options: RenderOptions, max_size: int):
        self._model = model
        shadows = options.preset == "shadows"
        quality = model.vis.quality
        quality.offsamples = 4 if shadows else 0
        quality.shadowsize = SHADOW_MAP_SIZE if shadows else 0
        quality.numslices, quality.numstacks, quality.numquads = (28, 16, 4) if shadows else (14, 8, 2)
        model.vis.global_.offwidth = model.vis.global_.offheight = max_size
        begin_drawing()
        self._owner = _Owner()
        self._gl = GLContext(max_size, max_size)
        self._gl.make_current()
        self.opengl_vendor = _opengl_string(GL_1_0.GL_VENDOR)
        self.opengl_renderer = _opengl_string(GL_1_0.GL_RENDERER)
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        # far things are close to 0, where floats are dense: noise of 0.3 um at 1.7 m instead of 5 um near 1
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self._scene = mujoco.MjvScene(model, maxgeom=200)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        for flag in (mujoco.mjtRndFlag.mjRND_REFLECTION, mujoco.mjtRndFlag.mjRND_SKYBOX):
            self._scene.flags[flag] = False
        self._option = mujoco.MjvOption()
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._free = weakref.finalize(self, _free, self._gl, self._context, self._owner)
        # Freed at exit too, before mujoco's own exit handler shuts OpenGL down: handlers run last in, first
        # out, but weakref registers its one handler early.
        self._free.atexit = False
        atexit.register(self._free)

    def draw(self, data: mujoco.MjData, camera: str, size: int) -> np.ndarray:
        viewport = self._render(data, camera, size)
        rgb = np.empty((size, size, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(rgb, None, viewport, self._context)
        return rgb[::-1].copy()

    def draw_depth(self, data: mujoco.MjData, camera: str, size: int) -> tuple[np.ndarray, np.ndarray]:
        viewport = self._render(data, camera, size)
        rgb = np.empty((size, size, 3), dtype=np.uint8)
        buffer = np.empty((size, size), dtype=np.float32)
        mujoco.mjr_readPixels(rgb, buffer, viewport, self._context)
        extent_m, planes = self._model.stat.extent, self._model.vis.map
        near_m, far_m = planes.znear * extent_m, planes.zfar * extent_m
        # the buffer holds 0 at the far plane and 1 at the near one, linear in 1 / depth
        depth_m = near_m * far_m / (near_m + buffer.astype(np.float64) * (far_m - near_m))
        return rgb[::-1].copy(), depth_m[::-1].astype(np.float32)

    def draw_geoms(self, data: mujoco.MjData, camera: str, size: int) -> np.ndarray:
        flags = self._scene.flags
        numbers = (mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR)
        for flag in numbers:
            flags[flag] = True
        try:
            viewport = self._render(data, camera, size)
        finally:
            for flag in numbers:
                flags[flag] = False
        rgb = np.empty((size, size, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(rgb, None, viewport, self._context)
        shown = rgb[::-1].astype(np.int32) @ [1, 1 << 8, 1 << 16]  # numbers of the drawn geoms, from 1
        geoms = np.full(self._scene.ngeom + 1, -1, dtype=np.int32)
        for drawn in self._scene.geoms[: self._scene.ngeom]:
            if drawn.segid >= 0 and drawn.objtype == mujoco.mjtObj.mjOBJ_GEOM:
                geoms[drawn.segid + 1] = drawn.objid
        return geoms[shown]

    def _render(self, data: mujoco.MjData, camera: str, size: int) -> mujoco.MjrRect:
        self._owner.check()
        self._gl.make_current()
        # again: after another renderer has drawn with GLFW, the previous image would be read
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._camera.fixedcamid = self._model.camera(camera).id
        mujoco.mjv_updateScene(
            self._model, data, self._option, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL, self._scene
        )
        viewport = mujoco.MjrRect(0, 0, size, size)
        mujoco.mjr_render(viewport, self._scene, self._context)
        return viewport

    def close(self) -> None:
        """Free the OpenGL context; only the thread that made it can."""
        self._owner.check()
        self._free()
        atexit.unregister(self._free)


def _free(gl: GLContext, context: mujoco.MjrContext, owner: _Owner) -> None:
    if not owner.is_here():
        for kept in (gl, context):  # for ever: here even their destructors would fail or hang
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(kept))
        return
    gl.make_current()
    context.free()
    gl.free()


def _opengl_string(name: int) -> str | None:
    """Return a string that describes the current OpenGL context; None if it has none."""
    pointer: Any = GL_1_0.glGetString(name)
    text = ctypes.cast(pointer, ctypes.c_char_p).value
    return None if text is None else text.decode()


def intrinsics(model: mujoco.MjModel, camera: str, size: int) -> np.ndarray:
    """(3, 3) float32 pixels of a (size, size) image; the centre of the top left pixel is (0, 0)."""
    focal_px = size / 2 / np.tan(np.deg2rad(model.camera(camera).fovy[0]) / 2)
    center_px = (size - 1) / 2
    return np.array([[focal_px, 0, center_px], [0, focal_px, center_px], [0, 0, 1]], dtype=np.float32)


def extrinsics(data: mujoco.MjData, camera: str) -> np.ndarray:
    """(4, 4) float32 world_from_camera, metres; camera axes x right, y down, z forward."""
    world_from_camera = np.eye(4, dtype=np.float32)
    # MuJoCo's cameras have y up and look along -z
    world_from_camera[:3, :3] = data.camera(camera).xmat.reshape(3, 3) * [1, -1, -1]
    world_from_camera[:3, 3] = data.camera(camera).xpos
    return world_from_camera


def compose_caption(images: list[np.ndarray], lines: list[str]) -> np.ndarray:
    """(H, W, 3) uint8: images of equal size side by side over a bar of text, smaller where a line is long."""
    import cv2  # only people's images need it, and it is slow to import

    row = np.concatenate(images, axis=1)
    bar = np.full((CAPTION_LINE_PX * len(lines) + 8, row.shape[1], 3), CAPTION_BACKGROUND, dtype=np.uint8)
    for i, line in enumerate(lines):
        origin = (CAPTION_MARGIN_PX, CAPTION_LINE_PX * (i + 1) - 4)
        scale, width = CAPTION_SCALE, row.shape[1] - 2 * CAPTION_MARGIN_PX
        while cv2.getTextSize(line, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)[0][0] > width:
            scale -= 0.01
        cv2.putText(bar, line, origin, cv2.FONT_HERSHEY_SIMPLEX, scale, (255, 255, 255), 1, cv2.LINE_AA)
    return np.concatenate([row, bar])
