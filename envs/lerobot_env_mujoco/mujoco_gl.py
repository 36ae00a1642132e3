"""MuJoCo, imported after an OpenGL backend has been chosen; every module here imports it from this one.

Its names live in C modules that pyright cannot read.
"""

from lerobot_env_mujoco.backend import ensure_gl_backend

ensure_gl_backend()

import mujoco as mujoco  # noqa: E402
