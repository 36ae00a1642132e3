"""`bomb_libero` draws wherever MuJoCo does, whatever CUDA_VISIBLE_DEVICES holds."""

import os
import platform
import subprocess
import sys
from importlib.util import find_spec

import pytest

pytestmark = pytest.mark.skipif(
    platform.system() != "Linux" or find_spec("robosuite") is None, reason="robosuite is not installed"
)

UUID = "GPU-5f0a3c5e-9d5e-4a0c-8f0e-1b2c3d4e5f60"
DRAW = """
import os
import lerobot_env_bomb.libero.renderer
from robosuite.utils.binding_utils import GLContext

GLContext(max_width=16, max_height=16, device_id=-1).make_current()
print(os.environ.get("CUDA_VISIBLE_DEVICES"))
"""


def draw(**environment: str) -> subprocess.CompletedProcess[str]:
    """Draw in a new process."""
    names = ("CUDA_VISIBLE_DEVICES", "MUJOCO_EGL_DEVICE_ID")
    clean = {name: value for name, value in os.environ.items() if name not in names}
    return subprocess.run(
        [sys.executable, "-c", DRAW], env=clean | environment, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize(
    "environment",
    [
        {"CUDA_VISIBLE_DEVICES": UUID},
        {"CUDA_VISIBLE_DEVICES": ""},
        {"CUDA_VISIBLE_DEVICES": "-1"},
        {"CUDA_VISIBLE_DEVICES": "99"},
        {"CUDA_VISIBLE_DEVICES": "7", "MUJOCO_EGL_DEVICE_ID": "0"},
    ],
)
def test_it_draws_whatever_names_the_gpus(environment: dict[str, str]) -> None:
    run = draw(**environment)
    assert run.returncode == 0, run.stderr
    assert run.stdout.splitlines()[-1] == environment["CUDA_VISIBLE_DEVICES"]


def test_a_device_that_there_is_not_is_named() -> None:
    run = draw(MUJOCO_GL="egl", MUJOCO_EGL_DEVICE_ID="99")
    assert "MUJOCO_EGL_DEVICE_ID environment variable must be an integer between 0 and" in run.stderr
    assert run.returncode != 0
