"""``lerobot-bomb config``: presets for those without a clone."""

from pathlib import Path

import pytest

from lerobot_bomb.commands.main import main
from lerobot_bomb.presets import preset_names

FOLDER = Path(__file__).parents[1] / "configs"


def test_every_config_file_is_a_preset(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config"]) == 0
    listed = capsys.readouterr().out.split()
    assert {FOLDER / f"{name}.yaml" for name in listed} == set(FOLDER.rglob("*.yaml"))
    assert listed == preset_names()


@pytest.mark.parametrize(
    "name",
    ["one_target_fdvla", "configs/one_target_fdvla.yaml", "ablations/fdvla_flow_only"],
)
def test_a_preset_is_printed_or_copied(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = FOLDER / f"{name.removeprefix('configs/').removesuffix('.yaml')}.yaml"
    assert main(["config", name]) == 0
    assert capsys.readouterr().out == path.read_text()
    copy = tmp_path / "configs" / "mine.yaml"
    assert main(["config", name, f"--output={copy}"]) == 0
    assert copy.read_text() == path.read_text()
    assert main(["config", name, f"--output={copy}"]) == 1
    assert "exists" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["one_target"], "there is no preset 'one_target'; `lerobot-bomb config` lists all"),
        (["../pyproject"], "there is no preset"),
        (["--output=x.yaml"], "--output=x.yaml needs the NAME of a preset"),
    ],
)
def test_wrong_names_are_told(flags: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", *flags]) == 1
    assert message in capsys.readouterr().err
