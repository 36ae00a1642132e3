import shlex
import subprocess
from pathlib import Path

import pytest

from lerobot_bomb.commands.main import main


@pytest.fixture(scope="module")
def script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("completion") / "lerobot-bomb"
    with pytest.MonkeyPatch.context() as patch, path.open("w") as file:
        patch.setattr("sys.stdout", file)
        assert main(["--completion=bash"]) == 0
    return path


def completions(script: Path, line: str) -> list[str]:
    """Return what bash offers for the last word of a line."""
    words = shlex.split(line) + [""] * line.endswith(" ")
    ask = (
        f"source {script}; COMP_WORDS=({' '.join(map(shlex.quote, words))}); COMP_CWORD={len(words) - 1}; "
        "function=$(complete -p lerobot-bomb); function=${function##*-F }; ${function% *} lerobot-bomb; "
        "printf '%s\\n' \"${COMPREPLY[@]}\""
    )
    ran = subprocess.run(["bash", "-c", ask], capture_output=True, text=True, cwd=script.parent, check=True)
    return ran.stdout.split()


def test_bash_reads_the_script(script: Path) -> None:
    subprocess.run(["bash", "-n", str(script)], check=True)


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("lerobot-bomb rec", ["record"]),
        ("lerobot-bomb conv", ["convert"]),
        ("lerobot-bomb convert ", ["pusht-zarr", "libero-hdf5"]),
        ("lerobot-bomb record --repo_id=me/x --epi", ["--episodes"]),
        ("lerobot-bomb view --policy.p", ["--policy.path"]),
        ("lerobot-bomb --completion ", ["bash", "zsh"]),
        ("lerobot-bomb checkpoint merge --out", ["--output"]),
        ("lerobot-bomb view gal", ["gallery"]),
        ("lerobot-bomb push ler", ["lerobot-bomb"]),  # a file
        ("lerobot-bomb record --root ler", ["lerobot-bomb"]),
    ],
)
def test_commands_flags_and_files_are_offered(script: Path, line: str, offered: list[str]) -> None:
    assert completions(script, line) == offered


def test_zsh_has_a_script_of_its_own(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--completion=zsh"]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("#compdef lerobot-bomb") and "--env.perturbations" in printed
