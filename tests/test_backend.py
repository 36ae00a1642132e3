import functools
import os
import platform
import subprocess
import sys

import pytest
from fresh_processes import FreshProcess

pytestmark = pytest.mark.skipif(platform.system() != "Linux", reason="the backend is chosen on Linux only")
CHOSEN = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "LEROBOT_BOMB_PROBED_GL", "DISPLAY", "WAYLAND_DISPLAY")


def without_choice() -> dict[str, str]:
    """Return this process' environment without a backend that was chosen, and without a display."""
    return {key: value for key, value in os.environ.items() if key not in CHOSEN}


def choose_backend(preamble: str = "", **environment: str) -> subprocess.CompletedProcess[str]:
    """Run ensure_gl_backend() in a fresh process without MUJOCO_GL unless given."""
    code = f"""
import os
from lerobot_env_bomb.shared import backend
{preamble}
print(backend.ensure_gl_backend(), os.environ["MUJOCO_GL"], os.environ["PYOPENGL_PLATFORM"])
"""
    return subprocess.run(
        [sys.executable, "-c", code],
        env=without_choice() | environment,
        capture_output=True,
        text=True,
        check=False,
    )


def last_line(run: subprocess.CompletedProcess[str]) -> str:
    return run.stderr.strip().splitlines()[-1]


def test_a_headless_machine_gets_a_working_backend() -> None:
    run = choose_backend()
    assert run.returncode == 0, run.stderr
    assert run.stdout.split() in (["egl"] * 3, ["osmesa"] * 3)


def test_osmesa_is_the_second_choice() -> None:
    run = choose_backend("backend.probe = lambda name: '' if name == 'osmesa' else 'broken'\n"
                         "backend.importlib.import_module = lambda name: None")  # fmt: skip
    assert run.stdout.split() == ["osmesa"] * 3, run.stderr


def test_without_any_library_the_packages_are_named() -> None:
    run = choose_backend("backend.probe = lambda name: f'no {name} here'")
    assert run.returncode != 0
    message = last_line(run)
    assert "apt-get install libegl1 libgl1" in message
    assert "apt-get install libosmesa6" in message
    assert "egl: no egl here" in message


def test_a_chosen_backend_without_its_library_names_the_packages() -> None:
    preamble = """
def broken(name):
    raise AttributeError("'NoneType' object has no attribute 'eglQueryString'")
backend.probe = lambda name: ""
backend.importlib.import_module = broken
"""
    run = choose_backend(preamble, MUJOCO_GL="egl")
    assert "apt-get install libegl1 libgl1" in last_line(run)


def test_ctrl_c_while_mujoco_loads_is_no_missing_library() -> None:
    preamble = """
def interrupted(name):
    raise ImportError("initialization failed") from KeyboardInterrupt()
backend.probe = lambda name: ""
backend.importlib.import_module = interrupted
"""
    assert last_line(choose_backend(preamble, MUJOCO_GL="egl")) == "KeyboardInterrupt"


def test_a_stale_pyopengl_platform_does_not_survive() -> None:
    preamble = "backend.probe = lambda name: ''; backend.importlib.import_module = lambda name: None"
    run = choose_backend(preamble, MUJOCO_GL="osmesa", PYOPENGL_PLATFORM="egl")
    assert run.stdout.split() == ["osmesa"] * 3, run.stderr


def test_a_chosen_backend_that_cannot_draw_is_told_before_it_draws() -> None:
    run = choose_backend(MUJOCO_GL="glfw")
    assert "OpenGL's backend glfw: mujoco.FatalError" in last_line(run)
    assert "use MUJOCO_GL=egl (Debian, Ubuntu: `apt-get install libegl1 libgl1`)" in last_line(run)


def test_a_chosen_backend_is_tried_in_the_first_process_only() -> None:
    preamble = "backend.probe = lambda name: 'tried'"
    assert "backend egl: tried. Without" in last_line(choose_backend(preamble, MUJOCO_GL="egl"))
    child = {"MUJOCO_GL": "osmesa", "LEROBOT_BOMB_PROBED_GL": "osmesa"}
    preamble += "; backend.importlib.import_module = lambda name: None"
    assert choose_backend(preamble, **child).stdout.split() == ["osmesa"] * 3


def test_lerobots_commands_say_in_a_line_that_nothing_can_be_drawn() -> None:
    flags = ["--policy.type=bomb_expert", "--env.type=bomb", "--eval.batch_size=2", "--eval.n_episodes=2"]
    program = "import sys; from lerobot.scripts import lerobot_eval; sys.argv[0] = 'lerobot-eval'\n"
    program += "lerobot_eval.main()"
    env = without_choice() | {"MUJOCO_GL": "glfw"}
    run = FreshProcess(program, *flags, "--eval.use_async_envs=true", env=env).wait()
    assert run.returncode == 1
    assert last_line(run).startswith("lerobot-eval: error: MuJoCo cannot render on this machine")
    assert "Traceback" not in run.stderr


def test_an_unknown_backend_is_refused() -> None:
    assert "MUJOCO_GL='vulkan' cannot render; choose one of: egl, osmesa, glfw" in last_line(
        choose_backend(MUJOCO_GL="vulkan")
    )


DRAWN = """
import hashlib, os
{first}
from lerobot_env_bomb.bomb.env import BombEnv

env = BombEnv()
pixels = env.reset(seed=1)[0]["pixels"]
env.close()
digest = hashlib.sha256(b"".join(each.tobytes() for each in pixels.values())).hexdigest()
print(os.environ["MUJOCO_GL"], digest)
"""


@functools.cache
def draw_after(first: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Draw an episode's first images in a fresh process, once this has run in it."""
    code = DRAWN.format(first=first)
    return subprocess.run(
        [sys.executable, "-c", code],
        env=without_choice() | environment,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize(
    "first",
    [
        "import mujoco",
        "os.environ['MUJOCO_GL'] = 'glfw'; import mujoco; del os.environ['MUJOCO_GL']",
        "os.environ['MUJOCO_GL'] = 'disable'; import mujoco; del os.environ['MUJOCO_GL']",
    ],
)
def test_the_same_images_whoever_has_imported_mujoco(first: str) -> None:
    expected, run = draw_after(""), draw_after(first)
    assert run.returncode == 0, run.stderr
    assert run.stdout == expected.stdout and run.stderr == ""


def test_a_backend_chosen_after_mujocos_import_is_the_one_that_draws() -> None:
    run = draw_after("import mujoco; os.environ['MUJOCO_GL'] = 'egl'")
    if "libegl1" in run.stderr:
        pytest.skip("EGL is not installed")
    assert run.stdout.startswith("egl "), run.stderr


def test_pyopengl_loaded_for_a_display_is_named() -> None:
    run = draw_after("import OpenGL.GL", MUJOCO_GL="egl")
    assert "OpenGL had been imported before for another backend (GLXPlatform)" in last_line(run)
    assert "start Python with PYOPENGL_PLATFORM=egl" in last_line(run)
    assert draw_after("import OpenGL.GL", MUJOCO_GL="egl", PYOPENGL_PLATFORM="egl").returncode == 0


BESIDE_A_NEIGHBOUR = """
import contextlib, mujoco
import numpy as np
from lerobot_env_bomb.bomb.env import BombEnv

env = BombEnv()
before = env.reset(seed=1)[0]["pixels"]
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='.2'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with contextlib.suppress(Exception):  # GLFW may find neither a display nor a library
    neighbour = mujoco.Renderer(model, 32, 32)
    neighbour.update_scene(data)
    neighbour.render()
after = env.reset(seed=1)[0]["pixels"]
print([bool(np.array_equal(before[camera], after[camera])) for camera in before])
env.close()
"""


def test_a_neighbour_that_draws_with_mujocos_own_context_changes_no_image() -> None:
    code = [sys.executable, "-c", BESIDE_A_NEIGHBOUR]
    run = subprocess.run(code, env=without_choice(), capture_output=True, text=True, check=False)
    assert run.stdout.strip() == "[True, True]", run.stderr
