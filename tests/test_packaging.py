import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml

from lerobot_bomb import __version__
from lerobot_bomb.commands.doctor import DISTRIBUTION
from lerobot_bomb.presets import preset_names

ROOT = Path(__file__).parents[1]
SOURCE_ROOTS = [ROOT, ROOT / "envs", ROOT / "policies"]


def build(target: str, source: Path, folder: Path, repository: str = "") -> Path:
    command = [sys.executable, "-m", "hatchling", "build", "-t", target, "-d", str(folder)]
    environment = {**os.environ, "REPOSITORY": repository, "PYTHONDONTWRITEBYTECODE": "1"}
    subprocess.run(command, cwd=source, env=environment, check=True, capture_output=True)
    (built,) = folder.iterdir()
    return built


def files(wheel: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build("wheel", ROOT, tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sdist's only folder."""
    with tarfile.open(build("sdist", ROOT, tmp_path_factory.mktemp("sdist"))) as archive:
        archive.extractall(folder := tmp_path_factory.mktemp("unpacked"), filter="data")
    (unpacked,) = folder.iterdir()
    return unpacked


def test_the_wheel_holds_every_module_the_scene_and_the_checkpoints(wheel: Path) -> None:
    packed = {name for name in files(wheel) if ".dist-info/" not in name}
    expected = {
        str(path.relative_to(root))
        for root in SOURCE_ROOTS
        for pattern in (
            "lerobot_*/**/*.py",
            "lerobot_*/**/py.typed",
            "lerobot_*/**/*.xml",
            "lerobot_*/checkpoints/weights/*/*",
        )
        for path in root.glob(pattern)
    }
    expected |= {f"lerobot_bomb/configs/{name}.yaml" for name in preset_names()}
    assert packed == expected
    assert "lerobot_env_bomb/bomb/scene.xml" in packed
    assert {f"{name.split('/')[0]}/py.typed" for name in packed} <= packed  # every package is typed


def test_the_sdist_builds_the_same_wheel(wheel: Path, unpacked: Path, tmp_path: Path) -> None:
    again = build("wheel", unpacked, tmp_path / "wheel")
    assert again.name == wheel.name
    assert files(again) == files(wheel)


def test_the_sdist_holds_what_is_under_version_control_without_images(unpacked: Path) -> None:
    packed = {str(path.relative_to(unpacked)) for path in unpacked.rglob("*") if path.is_file()}
    stray = [
        name
        for name in packed
        if re.search(r"(^|/)(\.venv|outputs|dist|__pycache__)/|\.(mp4|rrd|safetensors)$", name)
        and not name.startswith(("lerobot_bomb/checkpoints/weights/", "tests/fixtures/"))
    ]
    assert stray == [] and not (unpacked / "docs" / "media").exists()
    assert {
        "LICENSE",
        "README.md",
        "CHANGELOG.md",
        "constraints.txt",
        "configs/eval_bomb_place.yaml",
    } <= packed


def metadata(wheel: Path) -> str:
    (text,) = (content for name, content in files(wheel).items() if name.endswith("/METADATA"))
    return text.decode()


def test_a_package_index_shows_the_readme(wheel: Path, tmp_path: Path) -> None:
    readme = (ROOT / "README.md").read_text()
    assert metadata(wheel).endswith(readme)
    published = metadata(build("wheel", ROOT, tmp_path, repository="https://example.org/me/bomb/"))
    start = f"https://example.org/me/bomb/{{}}/v{__version__}/"
    targets = re.findall(r"\]\(([^)]+)\)", published)
    assert len(targets) == len(re.findall(r"\]\(([^)]+)\)", readme)) > 20
    assert [each for each in targets if not each.startswith("https://")] == []
    assert start.format("raw") + "docs/media/episode.gif" in targets
    assert start.format("blob") + "docs/benchmark.md#seeds" in targets
    assert "Project-URL: Repository, https://example.org/me/bomb\n" in published


def test_all_is_all_extras(wheel: Path) -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert extras.pop("all") == [f"lerobot_policy_bomb[{','.join(extras)}]"]


def test_versions_agree(wheel: Path) -> None:
    assert wheel.name == f"{DISTRIBUTION}-{__version__}-py3-none-any.whl"
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == __version__
    assert f"\n## {__version__}" in (ROOT / "CHANGELOG.md").read_text()


def test_the_page_on_versions_says_what_is_declared_and_pinned() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    declared = {"python": project["requires-python"]}
    for requirement in project["dependencies"]:
        name, _, bounds = re.split(r"((?:\[.*\])?)(?=[<>=]|$)", requirement, maxsplit=1)
        declared[name] = bounds
    pinned = dict(
        line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line
    )
    rows = re.findall(
        r"^\| `([\w-]+)` \| (.*?) \| (.*?) \|", (ROOT / "docs" / "releases.md").read_text(), re.M
    )
    assert [name for name, *_ in rows] == list(declared)
    for name, bounds, pin in rows:
        assert bounds.strip("`") == (declared[name] or "any"), name
        assert pin == ("3.12" if name == "python" else pinned[name]), name
