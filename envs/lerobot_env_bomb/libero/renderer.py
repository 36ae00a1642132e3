"""robosuite, imported so that it renders wherever MuJoCo does.

robosuite takes CUDA_VISIBLE_DEVICES for numbers of EGL's devices. But the variable may hold UUIDs, or numbers
of a machine whose container counts its own devices from 0.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import lerobot_env_bomb.shared.mujoco_gl  # noqa: F401  chooses MUJOCO_GL

GPUS = "CUDA_VISIBLE_DEVICES"


@contextmanager
def _all_gpus_visible() -> Iterator[None]:
    """Lift CUDA_VISIBLE_DEVICES: robosuite's import asserts that it lists MUJOCO_EGL_DEVICE_ID."""
    visible = os.environ.pop(GPUS, None)
    try:
        yield
    finally:
        if visible is not None:
            os.environ[GPUS] = visible


def or_mujocos(of_robosuite: Callable[[int], Any], of_mujoco: Callable[[], Any]) -> Callable[[int], Any]:
    """Return a function that makes EGL's display on robosuite's device or, if that fails, on MuJoCo's.

    MuJoCo takes the one of MUJOCO_EGL_DEVICE_ID, else the first that works.
    """

    def create(device_id: int = 0) -> Any:
        try:
            return of_robosuite(device_id)
        except (ValueError, RuntimeError):  # no number, or one that EGL does not have
            return of_mujoco()

    return create


with _all_gpus_visible():
    import robosuite.utils.binding_utils  # noqa: F401

if os.environ.get("MUJOCO_GL") == "egl":
    from mujoco import egl
    from robosuite.renderers.context import egl_context

    egl_context.create_initialized_egl_device_display = or_mujocos(
        egl_context.create_initialized_egl_device_display, egl.create_initialized_egl_device_display
    )
