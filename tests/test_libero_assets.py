"""LIBERO's installation is checked before it is imported: no question, no download, clear errors."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from lerobot_bomb.commands import doctor
from lerobot_bomb.commands.main import main
from lerobot_bomb.libero import assets
from lerobot_bomb.libero.assets import SUITES, Libero, prepare_libero

SUITE = "libero_spatial"
TASK = """(define (problem LIBERO_Tabletop_Manipulation)
  (:language Put the bowl on the stove)
  (:fixtures
    main_table - table
    stove_1 - stove
  )
  (:objects
    bowl_1 bowl_2 - bowl
  )
)"""
BOWL = '<mujoco><asset><!-- <mesh file="old.msh"/> --><mesh file="visual/bowl.msh"/></asset></mujoco>'
FILES = {
    "scenes/libero_tabletop_base_style.xml": "<mujoco/>",
    "articulated_objects/stove.xml": "<mujoco/>",
    "stable_scanned_objects/bowl/bowl.xml": BOWL,
    "stable_scanned_objects/bowl/visual/bowl.msh": "a mesh",
}
RECORDING = """
from lerobot_bomb.libero.episode import LiberoSpec
from lerobot_bomb.libero.goals import check_goals
check_goals([LiberoSpec(0)])
print("checked")
"""
IMPORT = """from lerobot_bomb.libero.assets import Libero
Libero.find().write_config()
import libero.libero
print("imported")"""


def run_code(code: str, **options: Any) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, **options)


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("LIBERO_CONFIG_PATH", raising=False)
    return tmp_path


@pytest.fixture
def libero(home: Path, monkeypatch: pytest.MonkeyPatch) -> Libero:
    """A small LIBERO of one task, with all that it needs."""
    libero = Libero(home / "site" / "libero" / "libero")
    for suite in assets.SUITES:
        write(libero.package / "bddl_files" / suite / "task.bddl", TASK)
    (libero.package / "init_files").mkdir()
    for name in assets.ASSET_FOLDERS:
        (libero.assets / name).mkdir(parents=True)
    for name, text in FILES.items():
        write(libero.assets / name, text)
    monkeypatch.setattr(Libero, "find", lambda: libero)
    return libero


def test_a_config_file_is_written_that_names_the_installed_tasks(libero: Libero, home: Path) -> None:
    assert prepare_libero() == libero
    values = yaml.safe_load((home / ".libero" / "config.yaml").read_text())
    assert values == {
        "benchmark_root": str(libero.package),
        "bddl_files": str(libero.package / "bddl_files"),
        "init_states": str(libero.package / "init_files"),
        "datasets": str(libero.package.parent / "datasets"),
        "assets": str(home / ".cache" / "libero" / "assets"),
    }
    assert list((home / ".libero").iterdir()) == [home / ".libero" / "config.yaml"]


def test_a_config_file_of_the_user_stays(libero: Libero, home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LIBERO_CONFIG_PATH", str(home / "mine"))
    text = yaml.safe_dump(
        {"bddl_files": str(libero.package / "bddl_files"), "init_states": str(home), "datasets": "/elsewhere"}
    )
    write(home / "mine" / "config.yaml", text)
    prepare_libero()
    assert (home / "mine" / "config.yaml").read_text() == text
    assert not (home / ".libero").exists()


BROKEN_CONFIGS: dict[str, tuple[str, str]] = {
    "empty": ("", "is empty or no mapping; delete it"),
    "cut off": ("bddl_files: [", "cannot be read"),
    "without tasks": ("datasets: /data", "has no bddl_files; delete the file, or set LIBERO_CONFIG_PATH"),
    "of an installation that is gone": (
        "bddl_files: /gone/bddl",
        "names bddl_files: /gone/bddl, which is no folder",
    ),
}


@pytest.mark.parametrize("case", BROKEN_CONFIGS)
def test_a_broken_config_file_is_named_and_left_alone(case: str, libero: Libero, home: Path) -> None:
    text, expected = BROKEN_CONFIGS[case]
    write(libero.config_file, text)
    with pytest.raises(ValueError, match=r"config\.yaml") as error:
        prepare_libero()
    assert str(libero.config_file) in str(error.value) and expected in str(error.value)
    assert libero.config_file.read_text() == text


def test_tasks_of_another_version_are_named(libero: Libero) -> None:
    (libero.package / "bddl_files" / "libero_90" / "task.bddl").unlink()
    assert prepare_libero([SUITE]) == libero
    with pytest.raises(
        ValueError, match=r"has no tasks of libero_90: LIBERO's .* is of another version; delete it"
    ):
        prepare_libero()


def test_a_config_folder_that_cannot_be_made_is_named(
    libero: Libero, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(home / "file", "")
    monkeypatch.setenv("LIBERO_CONFIG_PATH", str(home / "file"))
    with pytest.raises(
        ValueError, match=r"file/config.yaml cannot be written \(.*; set LIBERO_CONFIG_PATH to a"
    ):
        prepare_libero()


def truncate_model(folder: Path) -> None:
    (folder / "stable_scanned_objects/bowl/bowl.xml").write_text(BOWL[:-9])


# what is done to the assets -> what is missing then
PARTLY: dict[str, tuple[Callable[[Path], object], list[str]]] = {
    "a folder": (lambda p: (p / "turbosquid_objects").rmdir(), ["turbosquid_objects"]),
    "textures": (lambda p: (p / "textures").rmdir(), ["textures"]),
    "a mesh": (
        lambda p: (p / "stable_scanned_objects/bowl/visual/bowl.msh").unlink(),
        ["stable_scanned_objects/bowl/visual/bowl.msh"],
    ),
    "an object": (lambda p: (p / "articulated_objects/stove.xml").unlink(), ["*/stove.xml"]),
    "half an object": (truncate_model, ["stable_scanned_objects/bowl/bowl.xml"]),
    "a scene": (
        lambda p: (p / "scenes/libero_tabletop_base_style.xml").unlink(),
        ["scenes/libero_tabletop_base_style.xml"],
    ),
}


@pytest.mark.parametrize("case", PARTLY)
def test_what_is_missing_of_the_assets_is_named_with_the_way_out(case: str, libero: Libero) -> None:
    change, missing = PARTLY[case]
    change(libero.assets)
    libero.write_config()
    assert libero.missing_assets() == missing
    with pytest.raises(ValueError) as error:
        prepare_libero()
    assert str(error.value) == (
        f"LIBERO's assets in {libero.assets} are not whole or of another version: 1 missing ({missing[0]}); "
        f"hf download lerobot/libero-assets --repo-type=dataset --local-dir={libero.assets}"
    )


def test_assets_that_were_never_downloaded_are_named_with_the_way_out(libero: Libero, home: Path) -> None:
    libero.assets.rename(home / "elsewhere")
    with pytest.raises(
        ValueError, match=r"\.cache/libero/assets does not exist: hf download lerobot/libero-assets"
    ):
        prepare_libero()


def test_the_package_s_own_assets_come_first(libero: Libero) -> None:
    libero.assets.rename(libero.package / "assets")
    assert libero.assets == libero.package / "assets"
    assert prepare_libero().missing_assets() == []


def test_a_missing_installation_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Libero, "find", lambda: None)
    with pytest.raises(ValueError, match=r"LIBERO is not installed: pip install 'lerobot\[libero\]'"):
        prepare_libero()


def libero_lines(capsys: pytest.CaptureFixture[str], patch: pytest.MonkeyPatch) -> list[str]:
    """Return what `lerobot-bomb doctor` says of LIBERO."""
    patch.setattr(doctor, "CHECKS", (doctor.check_libero,))
    assert main(["doctor"]) == 0  # all else works without it
    _, *lines, summary = capsys.readouterr().out.splitlines()
    assert summary.startswith("everything works")
    return [line.strip() for line in lines]


def test_the_doctor_says_whether_libero_can_run(
    libero: Libero, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert libero_lines(capsys, monkeypatch) == [
        f"absent  libero: LIBERO has no {libero.config_file}, and asks on the standard input when it is "
        "imported; to have it written: echo n | python -c 'import libero.libero'"
    ]
    assert not libero.config_file.exists()
    libero.write_config()
    where = f"tasks in {libero.package / 'bddl_files'}, assets in {libero.assets}"
    assert libero_lines(capsys, monkeypatch) == [f"ok  libero: {', '.join(SUITES)} can run; {where}"]
    (libero.assets / "textures").rmdir()
    (libero.assets / "turbosquid_objects").rmdir()
    (line,) = libero_lines(capsys, monkeypatch)
    assert line.startswith("absent  libero: libero_spatial, ")
    assert "2 missing (textures, turbosquid_objects); hf download lerobot/libero-assets" in line
    monkeypatch.setattr(Libero, "find", lambda: None)
    (line,) = libero_lines(capsys, monkeypatch)
    assert line.startswith("absent  libero: not installed")


@pytest.fixture
def installed(home: Path) -> Libero:
    """The real one of this Python, with no config file yet."""
    libero = Libero.find()
    if libero is None:
        pytest.skip("hf-libero is not installed")
    return libero


@pytest.fixture
def with_assets(installed: Libero, home: Path, shared_data: Path) -> Libero:
    """The real one, with assets of libero_spatial."""
    (home / ".cache" / "libero").mkdir(parents=True)
    (home / ".cache" / "libero" / "assets").symlink_to(shared_data / "libero" / "assets")
    return installed


@pytest.mark.parametrize("stdin", [subprocess.DEVNULL, None])
def test_the_real_one_is_imported_without_a_question(
    installed: Libero, home: Path, stdin: int | None
) -> None:
    close = (lambda: os.close(0)) if stdin is None else None
    run = run_code(IMPORT, stdin=stdin, preexec_fn=close)
    assert run.stdout == "imported\n", run.stderr


def test_a_recording_needs_no_config_file(with_assets: Libero) -> None:
    run = run_code(RECORDING, stdin=subprocess.DEVNULL)
    assert run.stdout.endswith("checked\n"), run.stderr


def test_the_real_one_s_assets_suffice_for_one_suite_and_are_partly_missing_for_others(
    with_assets: Libero,
) -> None:
    assert prepare_libero([SUITE]) == with_assets
    assert with_assets.missing_assets(["libero_goal"]) == [
        "*/cream_cheese.xml",
        "*/wine_bottle.xml",
        "*/wine_rack.xml",
    ]


def test_the_doctor_names_the_suites_that_can_run(
    with_assets: Libero, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with_assets.write_config()
    can_run, cannot = libero_lines(capsys, monkeypatch)
    assert can_run.startswith("ok  libero: libero_spatial can run; tasks in ")
    assert cannot.startswith(
        "absent  other suites of libero: libero_object, libero_goal, libero_10, libero_90: "
    )


def test_every_scene_of_the_real_one_is_known(with_assets: Libero) -> None:
    with_assets.write_config()
    missing = [name for name in with_assets.missing_assets() if name.startswith("scenes/")]
    known = {f"scenes/{scene}.xml" for scene in assets.SCENES.values()}
    assert set(missing) == known - {"scenes/libero_tabletop_base_style.xml"}
    problems = "".join(path.read_text() for path in (with_assets.package / "envs" / "problems").glob("*.py"))
    assert all(f"scenes/{scene}.xml" in problems for scene in assets.SCENES.values())
