"""Change the code that numbers come from, one place at a time, and count the changes that no test notices.

`make mutants` tries a sample (`MUTANTS=400`); `make mutants MUTANTS=all` tries every one, for hours.
Which code is changed and which tests run on it stands in pyproject.toml under [tool.mutmut].
"""

import json
import os
import random
import subprocess
import sys
from collections import Counter
from pathlib import Path

from lerobot_bomb.stats import wilson_interval

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "mutants"
ANY_MUTANT = "lerobot_bomb.stats.x_wilson_interval__mutmut_1"
SURVIVED = (0, 5, 33)  # mutmut's exit codes: all tests passed, none was found, none runs the function
SEED = 0


def run_mutmut(names: list[str]) -> None:
    """Let mutmut write its mutants and test these."""
    command = [sys.executable, "-m", "mutmut", "run", "--max-children", str(os.cpu_count()), *names]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1"}
    environment.setdefault("SHARED_DATA", str(ROOT.parent / "shared" / "data"))
    subprocess.run(command, cwd=ROOT, env=environment, check=True)


def exit_codes() -> dict[str, int | None]:
    """Return mutmut's exit code for every mutant; None: not tested."""
    found: dict[str, int | None] = {}
    for path in sorted(FOLDER.rglob("*.meta")):
        found |= json.loads(path.read_text())["exit_code_by_key"]
    return found


def module_of(name: str) -> str:
    """Return the part of the package that a mutant is in, such as `flow`."""
    parts = name.split(".")
    return parts[1] if parts[1] in ("actions", "evaluation", "flow", "report", "stats") else parts[2]


def main() -> int:
    """Test a sample of mutants; print how many survived, by part, and a diff of each."""
    wanted = sys.argv[1] if len(sys.argv) > 1 else "400"
    if not (wanted == "all" or (wanted.isdecimal() and int(wanted) > 0)):
        sys.exit(f"MUTANTS={wanted}: give a number above 0, or all")
    run_mutmut([ANY_MUTANT])
    names = sorted(exit_codes())
    if wanted != "all":
        names = sorted(random.Random(SEED).sample(names, min(int(wanted), len(names))))
    run_mutmut(names)
    codes = exit_codes()
    survivors = [name for name in names if codes[name] in SURVIVED]
    for name in survivors:
        subprocess.run([sys.executable, "-m", "mutmut", "show", name], cwd=ROOT, check=True)
    tried, survived = (Counter(map(module_of, some)) for some in (names, survivors))
    for part in sorted(tried):
        print(f"{part:12} {survived[part]:4} of {tried[part]:4} survived")
    low, high = wilson_interval(len(survivors), len(names))
    rate = len(survivors) / len(names)
    print(f"{'all':12} {len(survivors):4} of {len(names):4} survived: {rate:.1%} [{low:.1%}, {high:.1%}]")
    return 0


if __name__ == "__main__":
    sys.exit(main())
