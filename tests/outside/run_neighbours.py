"""LeRobot's own tests with the plugin installed and without: `python run_neighbours.py CHECKOUT_OF_LEROBOT`.

Their outcomes must be the same: who installed the plugin and uses none of its types notices nothing.
"""

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory

from run_judges import environment, find_checkout

FOLDERS = ("configs", "processor", "datasets", "utils")
TESTS = (*(f"tests/{name}" for name in FOLDERS), "tests/test_yaml_policy_path.py")
WITH_PLUGIN, OUTCOMES = "NEIGHBOURS_WITH_PLUGIN", "NEIGHBOURS_OUTCOMES"  # environment variables


def outcomes(checkout: Path, with_plugin: bool) -> dict[str, str]:
    """{test: passed, failed or skipped}; those that need the network fail or skip in both."""
    with TemporaryDirectory() as folder:
        written = Path(folder) / "outcomes.json"
        variables = {WITH_PLUGIN: "1" * with_plugin, OUTCOMES: str(written)}
        options = [
            "-c",
            "pyproject.toml",
            "-p",
            "lerobot_neighbours",
            "-p",
            "no:cacheprovider",
            "-q",
            "--tb=no",
        ]
        # a file that cannot be imported here, as where FFmpeg is missing, says nothing of the plugin
        options += ["--continue-on-collection-errors"]
        subprocess.run(
            [sys.executable, "-m", "pytest", *options, *TESTS],
            cwd=checkout,
            env=environment() | variables,
            check=False,
        )
        return json.loads(written.read_text())


def main() -> int:
    """Compare both runs; 1 where a test says something else, or none passed."""
    checkout = find_checkout(sys.argv[1] if len(sys.argv) > 1 else "")
    without, beside = (outcomes(checkout, with_plugin) for with_plugin in (False, True))
    for name, counted in (("without", without), ("with", beside)):
        print(f"{name} the plugin: {dict(Counter(counted.values()))}")
    differing = sorted(test for test in without.keys() | beside if without.get(test) != beside.get(test))
    for test in differing:
        print(f"DIFFERS: {test}: {without.get(test)} without, {beside.get(test)} with")
    return int(bool(differing) or "passed" not in without.values())


if __name__ == "__main__":
    sys.exit(main())
