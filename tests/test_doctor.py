import importlib.metadata

import pytest

from lerobot_bomb.commands import doctor
from lerobot_bomb.commands.main import main


def test_a_sound_installation_passes(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor"]) == 0
    output = capsys.readouterr().out
    assert "everything works" in output
    for name in ("--env.type=bomb", "--policy.type=vla0_smol", "--policy.type=bomb_expert", "mujoco", "gpu"):
        assert f"ok  {name}: " in output


def test_a_broken_part_is_shown_with_its_cause(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken_import() -> None:
        raise ImportError("libEGL.so.1 is missing")

    monkeypatch.setattr(doctor, "CHECKS", (broken_import, doctor.check_gpu))
    assert main(["doctor"]) == 1
    output = capsys.readouterr().out
    assert "ImportError: libEGL.so.1 is missing" in output
    assert "ok  gpu" in output  # the other checks still run
    assert "1 broken" in output


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
