"""Build the sdist and the wheel into dist/, and use the wheel in an environment of its own: `make build`.

It sees the packages that ours needs, so nothing is downloaded; ours it has from the wheel only.
"""

import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).parents[2]
DIST = ROOT / "dist"
OURS = "lerobot_policy_bomb"
EXPERT = "--policy.type=bomb_expert --env.type=bomb --env.task=place --env.image_size=32"
# what runs in the new environment, and what its output must hold
COMMANDS = (
    ("lerobot-bomb --version", "lerobot-bomb {version}"),
    ("lerobot-bomb doctor", "everything works"),
    ("lerobot-bomb config train_fdvla_bomb", "type: fdvla"),
    ("python -m lerobot.scripts.lerobot_train --policy.type=vla0_smol --help", "--policy.vlm_model_name"),
    (
        f"python -m lerobot.scripts.lerobot_eval {EXPERT} --eval.n_episodes=1 --eval.batch_size=1",
        "'pc_success': 100.0",
    ),
)


def run(command: list[str | Path], cwd: Path) -> str:
    """Run a command and return what it prints; exit with that if it fails."""
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    ended = subprocess.run(
        command,
        cwd=cwd,
        env=clean | {"HF_HUB_OFFLINE": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    if ended.returncode:
        sys.exit(f"{ended.stdout}\nfailed: {' '.join(map(str, command))}")
    return ended.stdout


def show_others(environment: Path, folder: Path) -> None:
    """Let a new environment find all packages of this one but ours."""
    folder.mkdir()
    for path in Path(sysconfig.get_path("purelib")).iterdir():
        if OURS not in path.name:
            (folder / path.name).symlink_to(path)
    (site_packages,) = environment.glob("lib/python*/site-packages")
    # unlike a plain path, this reads the .pth files there
    (site_packages / "others.pth").write_text(f"import site; site.addsitedir({str(folder)!r})\n")


def main() -> None:
    """Build, install, run."""
    shutil.rmtree(DIST, ignore_errors=True)
    run([sys.executable, "-m", "hatchling", "build", "-d", DIST], ROOT)
    (wheel,) = DIST.glob("*.whl")
    (sdist,) = DIST.glob("*.tar.gz")
    run([sys.executable, "-m", "twine", "check", "--strict", wheel, sdist], ROOT)
    print("ok  twine check --strict", flush=True)
    version = sdist.name.removeprefix(f"{OURS}-").removesuffix(".tar.gz")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        environment = folder / "environment"
        venv.create(environment)
        show_others(environment, folder / "others")
        install = ["-m", "uv", "pip", "install", "--quiet", "--offline", "--no-deps", wheel, "--python"]
        run([sys.executable, *install, environment / "bin" / "python"], folder)
        for command, wanted in COMMANDS:
            program, *flags = command.split()
            if wanted.format(version=version) not in run([environment / "bin" / program, *flags], folder):
                sys.exit(f"{command}: its output lacks {wanted.format(version=version)!r}")
            print(f"ok  {command}", flush=True)
    print(f"{wheel.relative_to(ROOT)} and {sdist.name} can be published")
    if not os.environ.get("REPOSITORY"):
        print("but README's links are relative: make build REPOSITORY=URL makes them lead to a repository")


if __name__ == "__main__":
    main()
