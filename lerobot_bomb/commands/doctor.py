"""``lerobot-bomb doctor``: imports every part and says what is broken.

LeRobot swallows a plugin's import errors and then only says ``invalid choice``; this command shows them.
"""

import argparse
import importlib
import importlib.metadata
import os
import platform
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pkgutil import iter_modules

from packaging.requirements import Requirement

import lerobot_bomb
from lerobot_bomb.environments import ENVIRONMENTS
from lerobot_bomb.libero.assets import INSTALL, SUITES, Libero, describe_missing_assets

DISTRIBUTION = "lerobot_policy_bomb"
DEPENDENCIES = (
    "lerobot",
    "torch",
    "transformers",
    "mujoco",
    "gymnasium",
    "gymnasium-robotics",
    "opencv-python-headless",
    "rerun-sdk",
    "numpy",
)
# consequence of a version outside the declared range
OUTSIDE = {"mujoco": ": episodes and images are not those of the protocol, and results do not compare"}
HUB_TIMEOUT_S = 5


@dataclass(frozen=True)
class Component:
    """A checked part; only a broken one makes the installation unusable."""

    name: str
    detail: str
    broken: bool = False
    absent: bool = False  # a part that the others do without

    @property
    def mark(self) -> str:
        return "BROKEN" if self.broken else "absent" if self.absent else "ok"


def check_versions() -> Iterator[Component]:
    """Check Python, this package and its main dependencies."""
    yield Component("python", platform.python_version())
    for name in (DISTRIBUTION, *DEPENDENCIES):
        try:
            version = importlib.metadata.version(name)
            outside = _outside(name, version)
            yield Component(name, version + outside, broken=bool(outside))
        except importlib.metadata.PackageNotFoundError:
            hint = "LeRobot finds plugins by this name; pip install it" if name == DISTRIBUTION else ""
            yield Component(name, f"not installed. {hint}", broken=True)


def _outside(name: str, version: str) -> str:
    """Describe the range that this package declares, if an installed version lies outside it; else ""."""
    try:
        declared = [Requirement(text) for text in importlib.metadata.requires(DISTRIBUTION) or []]
    except importlib.metadata.PackageNotFoundError:  # reported as a component of its own
        return ""
    for requirement in declared:
        if requirement.name == name and not requirement.specifier.contains(version, prereleases=True):
            needed = f"{name}{requirement.specifier}"
            consequence = OUTSIDE.get(name, "")
            return f" lies outside {requirement.specifier}{consequence}; pip install '{needed}'"
    return ""


def check_rendering() -> Iterator[Component]:
    """Render one frame of the default scene, beside all of LeRobot's plugins that are installed."""
    # any of them may have loaded MuJoCo or OpenGL by the time that an environment draws
    importlib.import_module("lerobot.utils.import_utils").register_third_party_plugins()
    try:
        backend = importlib.import_module("lerobot_env_bomb.shared.backend").ensure_gl_backend()
    except (RuntimeError, ValueError) as error:
        yield Component("opengl", str(error), broken=True)
        return
    from lerobot_bomb.bomb.observation import PIXELS

    env = importlib.import_module("lerobot_env_bomb.bomb.env").BombEnv()
    observation, _ = env.reset(seed=0)
    env.close()
    contrast = max(int(image.max()) - int(image.min()) for image in observation[PIXELS].values())
    detail = f"{backend} renders"
    yield Component("opengl", detail if contrast else f"{backend} renders black frames", broken=not contrast)


def check_arms() -> Iterator[Component]:
    """Check that the arms of other packages can be used; BOMB's own needs nothing."""
    arm_files = importlib.import_module("lerobot_env_bomb.bomb.arm_files")
    for robot in arm_files.PACKAGES:
        try:
            arm_files.arm_xml(robot)
            yield Component(f"--env.robot={robot}", "can run")
        except ValueError as error:
            yield Component(f"--env.robot={robot}", str(error), absent=True)


def check_sapien() -> Iterator[Component]:
    """Check that the second simulator is installed, and that its renderer finds a driver."""
    simulators = importlib.import_module("lerobot_env_bomb.bomb.simulators")
    checks = {
        "simulator": lambda: simulators.import_with_sapien("sapien_physics") and "can run",
        "render_preset": lambda: simulators.import_with_sapien("sapien_render").device_name(),
    }
    for name, check in checks.items():
        flag = f"--env.{name}=sapien"
        try:
            simulators.check_simulator(**{name: "sapien"})
            yield Component(flag, check())
        except ValueError as error:
            yield Component(flag, str(error), absent=True)


def check_libero() -> Iterator[Component]:
    """Check that LIBERO is installed and has a config file and assets; nothing else needs it."""
    libero = Libero.find()
    if libero is None:
        yield Component("libero", f"not installed (for --env.type=libero: {INSTALL})", absent=True)
        return
    try:
        folders = libero.task_folders()
        missing = {suite: libero.missing_assets([suite]) for suite in SUITES}
    except ValueError as error:
        yield Component("libero", str(error), absent=True)
        return
    whole = [suite for suite in SUITES if not missing[suite]]
    if whole:
        detail = f"{', '.join(whole)} can run; tasks in {folders['bddl_files']}, assets in {libero.assets}"
        yield Component("libero", detail)
    if len(whole) < len(SUITES):
        others = [suite for suite in SUITES if missing[suite]]
        found = describe_missing_assets(libero.assets, sorted(set().union(*missing.values())))
        name = "other suites of libero" if whole else "libero"
        yield Component(name, f"{', '.join(others)}: {found}", absent=True)


def check_types() -> Iterator[Component]:
    """Check that LeRobot knows the env and policy types that the plugin imports, and their classes."""
    plugin = importlib.import_module(DISTRIBUTION)
    from lerobot.configs import PreTrainedConfig
    from lerobot.envs import EnvConfig
    from lerobot.policies.factory import get_policy_class

    for name in ENVIRONMENTS:
        known = name in EnvConfig.get_known_choices()
        yield Component(f"--env.type={name}", "registered" if known else "not registered", broken=not known)
    for name in (module.name for module in iter_modules(plugin.__path__) if module.ispkg):
        known = name in PreTrainedConfig.get_known_choices()
        detail = get_policy_class(name).__name__ if known else "not registered"
        yield Component(f"--policy.type={name}", detail, broken=not known)


def check_gpu() -> Iterator[Component]:
    """Check the accelerator that torch would use; none is fine for the nano presets."""
    torch = importlib.import_module("torch")
    if torch.cuda.is_available():
        yield Component("gpu", torch.cuda.get_device_name())
    else:
        detail = "none (policies run on the CPU; use --policy.vlm_model_name=nano)"
        yield Component("gpu", detail, absent=True)


def check_hub() -> Iterator[Component]:
    """Check that pretrained backbones can be downloaded; nano and local folders do not need it."""
    hub = importlib.import_module("huggingface_hub")
    if hub.constants.HF_HUB_OFFLINE:
        detail = "offline by HF_HUB_OFFLINE; nano and local folders work"
        yield Component("hugging face hub", detail, absent=True)
        return
    try:
        hub.get_session().head(hub.constants.ENDPOINT, timeout=HUB_TIMEOUT_S)
        yield Component("hugging face hub", "reachable")
    except Exception as error:  # the session's own errors differ by transport
        detail = f"not reachable: {type(error).__name__} (nano and local folders work)"
        yield Component("hugging face hub", detail, absent=True)


CHECKS: tuple[Callable[[], Iterator[Component]], ...] = (
    check_versions,
    check_rendering,
    check_arms,
    check_sapien,
    check_libero,
    check_types,
    check_gpu,
    check_hub,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare no arguments: ``lerobot-bomb doctor`` has none."""


def run(args: argparse.Namespace) -> int:
    """Print every component; exit code 1 and the causes when something is broken."""
    print(f"lerobot_bomb {lerobot_bomb.__version__}, MUJOCO_GL={os.environ.get('MUJOCO_GL', '(unset)')}")
    num_broken, absent = 0, []
    for check in CHECKS:
        try:
            for component in check():
                num_broken += component.broken
                absent += [component.name] if component.absent else []
                print(f"{component.mark:>6}  {component.name}: {component.detail}", flush=True)
        except Exception:  # any cause must be shown, and the other checks still run
            num_broken += 1
            name = check.__name__.removeprefix("check_")
            print(f"BROKEN  {name}:\n{traceback.format_exc()}", flush=True)
    if num_broken:
        print(f"{num_broken} broken, see above")
    else:
        print("everything works" + (f"; absent: {', '.join(absent)}" if absent else ""))
    return int(num_broken > 0)
