"""Tests and judges with another LeRobot, Python or plugin: `python try_lerobot.py CHECKOUT_OF_LEROBOT`.

LeRobot is installed from the checkout into `.venv-lerobot`. Of all else, the versions are those of
constraints.txt where this LeRobot allows them.
"""

import argparse
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from run_judges import ROOT, checkout_version

FOLDER = ROOT / ".venv-lerobot"
LEROBOT = "lerobot"


def preferred(constraints: str) -> str:
    """The versions of constraints.txt but LeRobot's, from which uv departs where they do not fit."""
    lines = [line for line in constraints.splitlines() if line.partition("==")[0] != LEROBOT]
    return "\n".join(lines) + "\n"


def install(checkout: Path, base_python: str, extras: str, plugins: Sequence[str]) -> Path:
    """Make the environment of a Python, with other plugins of LeRobot; return its Python."""
    python, required, versions = FOLDER / "bin" / "python", FOLDER / "required.txt", FOLDER / "versions.txt"
    run([sys.executable, "-m", "uv", "venv", "-q", "--clear", "-p", base_python, str(FOLDER)])
    own = f"-e .[{extras}]", f"{LEROBOT} @ {checkout.as_uri()}"
    required.write_text("\n".join([*own, *plugins]) + "\n")
    versions.write_text(preferred((ROOT / "constraints.txt").read_text()))
    # a checkout names an index of its own for torch, a released LeRobot does not
    uv = [sys.executable, "-m", "uv", "pip"]
    resolve = ["compile", "-q", "--no-sources", "--no-header", "--no-annotate", "-p", str(python)]
    run([*uv, *resolve, str(required), "--group", "dev", "-o", str(versions)])
    run([*uv, "install", "-q", "--no-sources", "-p", str(python), "-r", str(versions)])
    return python


def run(command: Sequence[str]) -> None:
    """Run a command in the project's folder; exit if it fails."""
    returned = subprocess.run(command, cwd=ROOT, check=False).returncode
    if returned:
        sys.exit(returned)


def main() -> int:
    """Install, test and judge; 0 if both pass."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkout", help="folder of a LeRobot")
    parser.add_argument("--extras", required=True, help="of this package, joined by commas")
    parser.add_argument("--python", default=sys.executable, help="another Python")
    parser.add_argument("--plugins", nargs="*", default=[], help="packages to install beside")
    args = parser.parse_args()
    checkout = Path(args.checkout).expanduser().resolve()
    found = checkout_version(checkout) if args.checkout else None
    if found is None:
        sys.exit(f"LEROBOT_SRC={args.checkout} is not a checkout of LeRobot")
    print(f"Installing LeRobot {found} of {checkout} into {FOLDER}", flush=True)
    python = str(install(checkout, args.python, args.extras, args.plugins))
    options = [
        "-n",
        "auto",
        "--maxprocesses=4",
        "--dist=loadfile",
        "--no-loadscope-reorder",
        "-m",
        "not long",
    ]
    tests = [[python, "-m", "pytest", *options]]
    tests += [
        [python, f"tests/outside/{name}.py", str(checkout)] for name in ("run_judges", "run_neighbours")
    ]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    returned = [subprocess.run(test, cwd=ROOT, env=environment, check=False).returncode for test in tests]
    return int(any(returned))


if __name__ == "__main__":
    sys.exit(main())
