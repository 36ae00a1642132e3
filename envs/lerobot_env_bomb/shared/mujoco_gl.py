"""MuJoCo and its OpenGL context, on a backend that renders. Every module here imports both from this one.

MuJoCo's names live in C modules that pyright cannot read.
"""

import importlib
from typing import Any

from lerobot_env_bomb.shared.backend import ensure_gl_backend

_backend = ensure_gl_backend()

import mujoco as mujoco  # noqa: E402

# mujoco.GLContext is of the backend of mujoco's first import, which may have been another package's
_module = mujoco if _backend == "default" else importlib.import_module(f"mujoco.{_backend}")
GLContext: Any = _module.GLContext  # pyright: ignore[reportAttributeAccessIssue]
