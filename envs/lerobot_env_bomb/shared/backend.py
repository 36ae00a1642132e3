"""Chooses MuJoCo's OpenGL backend, whether or not mujoco has been imported."""

import importlib
import os
import platform
import subprocess
import sys

BACKENDS = ("egl", "osmesa", "glfw")
PACKAGES = {"egl": "libegl1 libgl1", "osmesa": "libosmesa6"}  # headless ones, in order of speed
PYOPENGL = {"egl": "EGLPlatform", "osmesa": "OSMesaPlatform"}  # classes of PyOpenGL
PROBED = "LEROBOT_BOMB_PROBED_GL"  # environment variable: the backend that a parent process has tried
PROBE_TIMEOUT_S = 60
# without a display, GLFW makes a context; MuJoCo reports only later, on loading, that it lacks functions
_PROBE = """
import mujoco
gl = mujoco.GLContext(16, 16)
gl.make_current()
context = mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), mujoco.mjtFontScale.mjFONTSCALE_100)
context.free()
gl.free()
"""


class NoOpenGLError(RuntimeError):
    """Error that MuJoCo cannot render on this machine."""


def probe(backend: str) -> str:
    """Try a backend in a fresh process; return '' when it renders, else the last line of its error."""
    env = os.environ | {"MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend}
    try:
        run = subprocess.run(
            [sys.executable, "-c", _PROBE], env=env, capture_output=True, text=True, timeout=PROBE_TIMEOUT_S
        )
    except subprocess.TimeoutExpired:
        return f"no answer in {PROBE_TIMEOUT_S} s"
    if run.returncode == 0:
        return ""
    lines = run.stderr.strip().splitlines()
    return lines[-1] if lines else f"the probe ended with exit code {run.returncode}"


def ensure_gl_backend() -> str:
    """Set MUJOCO_GL (and PYOPENGL_PLATFORM) to a backend that renders and return its name.

    A backend is tried once, in the first process: child processes inherit it and lose no time. Off Linux,
    MuJoCo's own default is kept. `mujoco.GLContext` uses this backend unless mujoco was imported before;
    `lerobot_env_bomb.shared.mujoco_gl.GLContext` always does.

    Raises:
        NoOpenGLError: no backend can render, or the one that MUJOCO_GL names cannot; the message names the
            Debian packages to install. Or PyOpenGL has been loaded for another backend, for which it stays
            until the process ends.
        ValueError: MUJOCO_GL holds an unknown name.
    """
    chosen = os.environ.get("MUJOCO_GL", "").lower()
    if platform.system() != "Linux":
        return "default"
    if chosen and chosen not in BACKENDS:
        raise ValueError(f"MUJOCO_GL={chosen!r} cannot render; choose one of: {', '.join(BACKENDS)}")
    if not chosen:
        chosen = _first_working_backend()
    elif chosen != os.environ.get(PROBED) and (cause := probe(chosen)):
        raise NoOpenGLError(_advice({chosen: cause}))
    _check_pyopengl(chosen)
    os.environ["MUJOCO_GL"] = os.environ[PROBED] = chosen
    # PyOpenGL reads a variable of its own; one left over from another backend makes mujoco raise.
    if chosen in PACKAGES:
        os.environ["PYOPENGL_PLATFORM"] = chosen
    try:
        importlib.import_module("mujoco")
        importlib.import_module(f"mujoco.{chosen}")
    except (AttributeError, ImportError) as error:
        if isinstance(error.__cause__, KeyboardInterrupt):  # Ctrl-C while its library loads
            raise error.__cause__ from None
        # this is how a missing libEGL or libOSMesa shows
        raise NoOpenGLError(_advice({chosen: str(error)})) from error
    return chosen


def _check_pyopengl(backend: str) -> None:
    """Raise a NoOpenGLError if PyOpenGL was loaded for another backend."""
    loaded = sys.modules.get("OpenGL.platform")
    needed = PYOPENGL.get(backend)
    if loaded is None or needed in (None, (found := type(loaded.PLATFORM).__name__)):
        return
    raise NoOpenGLError(
        f"MuJoCo cannot render with {backend}: OpenGL had been imported before for another backend "
        f"({found}). Import lerobot_env_bomb.bomb.env first, or start Python with PYOPENGL_PLATFORM={backend}"
    )


def _first_working_backend() -> str:
    causes = {}
    for backend in PACKAGES:
        causes[backend] = probe(backend)
        if not causes[backend]:
            return backend
    raise NoOpenGLError(_advice(causes))


def _advice(causes: dict[str, str]) -> str:
    """Describe what failed and the way out; `causes`: {backend that was tried: why it cannot render}."""
    tried = "; ".join(f"{name}: {cause}" for name, cause in causes.items())
    ways = " or ".join(
        f"MUJOCO_GL={name} (Debian, Ubuntu: `apt-get install {packages}`)"
        for name, packages in PACKAGES.items()
    )
    return (
        f"MuJoCo cannot render on this machine with OpenGL's backend {tried}. Without a display, use {ways}"
    )
