import importlib.metadata
import os
import sys
from pathlib import Path

import pytest

from lerobot_bomb.commands import doctor
from lerobot_bomb.commands.main import main


def test_a_sound_installation_passes(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor"]) == 0
    output = capsys.readouterr().out
    assert "everything works" in output
    policies = ("vla0_smol", "spatialvla_grid", "fdvla", "bomb_expert", "bomb_random")
    types = ("--env.type=bomb", *(f"--policy.type={name}" for name in policies))
    for name in (*types, "mujoco"):
        assert f"ok  {name}: " in output


def test_a_part_that_others_do_without_is_named_when_it_is_absent(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import torch

    monkeypatch.setattr(doctor, "CHECKS", (doctor.check_gpu, doctor.check_hub))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert main(["doctor"]) == 0
    output = capsys.readouterr().out
    assert "absent  gpu: none" in output
    assert "absent  hugging face hub: offline by HF_HUB_OFFLINE" in output
    assert output.splitlines()[-1] == "everything works; absent: gpu, hugging face hub"


def test_a_broken_part_is_shown_with_its_cause(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken_import() -> None:
        raise ImportError("libEGL.so.1 is missing")

    monkeypatch.setattr(doctor, "CHECKS", (broken_import, doctor.check_gpu))
    assert main(["doctor"]) == 1
    output = capsys.readouterr().out
    assert "ImportError: libEGL.so.1 is missing" in output
    assert "  gpu: " in output  # the other checks still run
    assert "1 broken" in output


def test_a_policy_that_cannot_be_imported_is_shown_with_its_cause(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delitem(sys.modules, doctor.DISTRIBUTION)
    monkeypatch.setitem(sys.modules, "lerobot_policy_bomb.fdvla", None)
    monkeypatch.setattr(doctor, "CHECKS", (doctor.check_types,))
    assert main(["doctor"]) == 1
    output = capsys.readouterr().out
    assert "BROKEN  types:" in output
    assert "import of lerobot_policy_bomb.fdvla halted" in output


def test_a_package_that_registers_no_type_of_its_name_is_broken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "nothing").mkdir()
    (tmp_path / "nothing" / "__init__.py").touch()
    plugin = importlib.import_module(doctor.DISTRIBUTION)
    monkeypatch.setattr(plugin, "__path__", [*plugin.__path__, str(tmp_path)])
    monkeypatch.setattr(doctor, "ENVIRONMENTS", ("bomb", "nothing"))
    broken = [finding for finding in doctor.check_types() if finding.broken]
    assert [(finding.name, finding.detail) for finding in broken] == [
        ("--env.type=nothing", "not registered"),
        ("--policy.type=nothing", "not registered"),
    ]


@pytest.mark.parametrize("version", ["3.8.0", "3.10.0", "4.0.0"])
def test_a_simulator_outside_the_range_of_equal_bits_is_named(
    version: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.metadata, "version", lambda name: version)
    monkeypatch.setattr(doctor, "DEPENDENCIES", ("mujoco",))
    (broken,) = [finding for finding in doctor.check_versions() if finding.broken]
    assert broken.name == "mujoco" and broken.detail.startswith(f"{version} lies outside <3.10,>=3.8.1")
    assert "results do not compare" in broken.detail


@pytest.mark.parametrize("version", ["3.8.1", "3.9.0"])
def test_a_simulator_of_equal_bits_passes(version: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.metadata, "version", lambda name: version)
    monkeypatch.setattr(doctor, "DEPENDENCIES", ("mujoco",))
    assert not any(finding.broken for finding in doctor.check_versions())


def test_a_missing_dependency_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "DEPENDENCIES", ("no-such-distribution",))
    broken = [finding for finding in doctor.check_versions() if finding.broken]
    assert [finding.name for finding in broken] == ["no-such-distribution"]


def test_it_draws_beside_every_installed_plugin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One that spoils the drawing as soon as LeRobot imports it."""
    (tmp_path / "lerobot_env_spoiler.py").write_text("import os\nos.environ['MUJOCO_GL'] = 'vulkan'\n")
    metadata = tmp_path / "lerobot_env_spoiler-1.0.dist-info" / "METADATA"
    metadata.parent.mkdir()
    metadata.write_text("Metadata-Version: 2.1\nName: lerobot_env_spoiler\nVersion: 1.0\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("MUJOCO_GL", os.environ.get("MUJOCO_GL", ""))  # restored afterwards
    monkeypatch.setattr(doctor, "CHECKS", (doctor.check_rendering,))
    assert main(["doctor"]) == 1
    assert "BROKEN  opengl: MUJOCO_GL='vulkan' cannot render" in capsys.readouterr().out
