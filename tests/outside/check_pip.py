"""The lines for pip users, in an empty environment: `python check_pip.py`. It downloads gigabytes."""

import os
import re
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).parents[2]
CHECK = """
import re
from importlib.metadata import distributions
import cv2
found = sorted(each.name for each in distributions() if each.name.startswith("opencv"))
assert found == ["opencv-python-headless"], found
assert re.search(r"GUI: +NONE", cv2.getBuildInformation())
from lerobot_bomb.commands.main import main
raise SystemExit(main(["doctor"]))
"""


def blocks() -> list[str]:
    """The commands of docs/releases.md: with uv, with pip."""
    section = (ROOT / "docs" / "releases.md").read_text().partition("\n## With pip alone\n")[2]
    return re.findall(r"^```\n(.*?)^```$", section.partition("\n## ")[0], re.MULTILINE | re.DOTALL)


def main() -> None:
    """Follow each block; raises where a command or the check fails."""
    with_uv, with_pip = blocks()
    for commands in (with_uv, with_pip):
        with TemporaryDirectory() as folder:
            subprocess.run([sys.executable, "-m", "venv", folder], check=True)
            path = f"{folder}/bin{os.pathsep}{os.environ['PATH']}"
            environment = os.environ | {"PATH": path, "VIRTUAL_ENV": folder}
            subprocess.run(["bash", "-exc", commands], cwd=ROOT, env=environment, check=True)
            subprocess.run([f"{folder}/bin/python", "-c", CHECK], cwd=folder, env=environment, check=True)


if __name__ == "__main__":
    main()
