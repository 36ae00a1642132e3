"""Run LeRobot's own tests on our policy and env types: `python run_judges.py CHECKOUT_OF_LEROBOT`."""

import json
import os
import subprocess
import sys
import tomllib
from importlib.metadata import distribution, version
from pathlib import Path

ROOT = Path(__file__).parents[2]
# tests that get our names in the place of LeRobot's
CLASSES = "tests/policies/test_policies.py::test_get_policy_and_config_classes"
BUILD = "tests/policies/test_policies.py::test_policy_defaults"
SAVE_AND_LOAD = "tests/policies/test_policies.py::test_save_and_load_pretrained"
MAKE_ENV = "tests/envs/test_envs.py::test_factory"
# tests that run on whatever is registered, or beside it
FILES = (
    "tests/envs/test_dispatch.py",
    "tests/envs/test_freeze_after_episode_end.py",
    "tests/configs/test_plugin_loading.py",
    "tests/processor/test_pipeline.py",
)


def checkout_version(folder: Path) -> str | None:
    """Version of LeRobot in a checkout; None if it is none."""
    try:
        project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
        return project["version"] if project["name"] == "lerobot" else None
    except (OSError, tomllib.TOMLDecodeError, KeyError):
        return None


def is_installed_from(folder: Path) -> bool:
    """Return whether the installed LeRobot is that of this checkout (`make test-lerobot`)."""
    origin = json.loads(distribution("lerobot").read_text("direct_url.json") or "{}")
    return origin.get("url") == folder.as_uri()


def find_checkout(given: str) -> Path:
    """The folder that LEROBOT_SRC names; exits unless its tests are those of the installed version."""
    installed = version("lerobot")
    way_out = (
        f"get one with: git clone --depth 1 --branch v{installed} https://github.com/huggingface/lerobot; "
        f"then: make judges LEROBOT_SRC=lerobot"
    )
    if not given:
        sys.exit(f"LEROBOT_SRC is missing: give a checkout of LeRobot {installed}; {way_out}")
    folder = Path(given).expanduser().resolve()
    found = checkout_version(folder)
    if found is None or not (folder / "tests").is_dir():
        sys.exit(f"LEROBOT_SRC={given} is not a checkout of LeRobot; {way_out}")
    if found != installed:
        sys.exit(f"LEROBOT_SRC={given} is LeRobot {found}, installed is {installed}; {way_out}")
    if (folder / ".git").exists() and not is_installed_from(folder):
        # the branch main keeps the last release's number
        same = subprocess.run(["git", "-C", folder, "diff", "--quiet", f"v{installed}", "--", "tests"])
        if same.returncode:
            sys.exit(f"LEROBOT_SRC={given}: tests/ is not that of the tag v{installed}; {way_out}")
    return folder


def environment() -> dict[str, str]:
    """Variables of a pytest that runs in the checkout, which stays untouched."""
    return os.environ | {
        "PYTHONPATH": os.pathsep.join(str(ROOT / folder) for folder in ("tests/outside", "benchmarks")),
        "PYTHONDONTWRITEBYTECODE": "1",
        # pytest's plugins that happen to be installed, and options meant for other runs
        "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
        "PYTEST_ADDOPTS": "",
        "HF_HUB_OFFLINE": "1",
        "OMP_NUM_THREADS": "1",
        "LEROBOT_TEST_DEVICE": "cpu",
    }


def main() -> int:
    """Run the judges in the checkout and return pytest's exit status."""
    folder = find_checkout(sys.argv[1] if len(sys.argv) > 1 else "")
    judges = [CLASSES, BUILD, SAVE_AND_LOAD, MAKE_ENV, *FILES]
    options = ["-c", "pyproject.toml", "-p", "lerobot_judges", "-p", "no:cacheprovider", "-q", "-ra"]
    return subprocess.run(
        [sys.executable, "-m", "pytest", *options, *judges], cwd=folder, env=environment()
    ).returncode


if __name__ == "__main__":
    sys.exit(main())
