"""`lerobot-bomb push`: what is published and what is refused; tests/hub/test_loop.py trains on it."""

import re
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import yaml

from hub.dataset_damage import DATASET_DAMAGES
from hub.server import TOKEN, LoopbackHub
from lerobot_bomb.commands.main import main
from lerobot_bomb.data.facts import DatasetFacts
from lerobot_bomb.data.recording import Recording
from lerobot_bomb.hub.dataset import FIGURE, dataset_card, figure

REPO_ID = "me/d"
RECORDING = asdict(Recording(REPO_ID, episodes=16))
COUNTS = {"total_episodes": 3, "total_frames": 60, "fps": 10}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Path], Path]:
    root = tmp_path_factory.mktemp("recorded") / "dataset"
    flags = ["--episodes=2", "--seed=7", "--image_size=64", "--images", "--perturbations=camera:2"]
    assert main(["record", f"--repo_id={REPO_ID}", f"--root={root}", *flags]) == 0
    return lambda folder: copy(root, folder / "dataset")


def copy(root: Path, folder: Path) -> Path:
    for path in root.rglob("*"):
        if path.is_file():
            target = folder / path.relative_to(root)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(path.read_bytes())
    return folder


def push(root: Path, *flags: str) -> int:
    return main(["push", str(root), f"--repo_id={REPO_ID}", *flags])


def test_one_commit_tagged_for_lerobot_with_a_card(
    online: LoopbackHub,
    recorded: Callable[[Path], Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    root = recorded(tmp_path)
    assert push(root, "--dry_run") == 0
    foreseen = capsys.readouterr().out
    assert online.requests == []
    assert push(root) == 0
    repository = online.dataset(REPO_ID)
    assert len(repository.messages) == 1
    assert repository.refs["v3.0"] == repository.refs["main"]
    files = repository.files()
    for path in root.rglob("*.*"):
        assert files[path.relative_to(root).as_posix()] == path.read_bytes()
    card = files["README.md"].decode()
    assert foreseen.startswith(card)
    assert set(foreseen[len(card) :].split()) == files.keys() - {"README.md"}
    assert files[FIGURE].startswith(b"<svg ") and f"]({FIGURE})" in card
    assert yaml.safe_load(card.split("---\n")[1])["task_categories"] == ["robotics"]
    for part in (
        "suite place",
        "camera:2",
        "seeds 7..8",
        "--env.type=bomb",
        f"--dataset.repo_id={REPO_ID}",
        "license: apache-2.0",
        "@misc{lerobot_bomb,",
        "the scripted expert's successes alone were kept",
    ):
        assert part in card
    assert str(tmp_path) not in card
    assert push(root) == 0  # again: the tag moves on
    assert repository.refs["v3.0"] == repository.refs["main"]


def test_the_card_tells_how_often_the_expert_succeeded() -> None:
    failures = [{"seed": seed, "failure": "dropped" if seed > 1 else "imprecise"} for seed in range(5)]
    facts = DatasetFacts(
        {**COUNTS, "codebase_version": "v3.0", "features": {}},
        {"num_episodes": 15, "failures": failures, "recording": RECORDING},
    )
    card = dataset_card(REPO_ID, facts)
    assert "The scripted expert succeeded in 15/20 = 75.0 % [53.1, 88.8] of the episodes it ran" in card
    drawn = figure(facts)
    assert drawn is not None
    # per cent of each class, in the bar
    assert re.findall(r">(\d+)</text>", drawn.decode().split("per cent of episodes")[-1]) == [
        "75",
        "15",
        "10",
    ]
    relabelled = replace(facts, bomb={**facts.bomb, "recording": {**RECORDING, "relabel": "0" * 64}})
    assert figure(relabelled) is None and "successes" not in dataset_card(REPO_ID, relabelled)


def test_the_card_of_converted_data_claims_no_licence_and_names_its_source() -> None:
    info = {
        **COUNTS,
        "codebase_version": "v3.0",
        "features": {"action": {"dtype": "float32", "shape": [4], "names": None}},
    }
    converted = dataset_card("me/d", DatasetFacts(info, {"conversion": {"source": "pusht-zarr <b>0123"}}))
    assert "license" not in converted.split("---\n")[1]
    assert "its source holds (pusht-zarr &lt;b&gt;0123)" in converted
    assert "the authors of the demonstrations" in converted
    assert "--env.type=pusht" in converted
    others = dataset_card("me/d", DatasetFacts(info, {"conversion": {"source": "other"}}))
    assert "lerobot-eval" not in others  # its environment is not known


def test_nothing_of_a_longer_recording_is_left(
    online: LoopbackHub, recorded: Callable[[Path], Path], tmp_path: Path
) -> None:
    """LeRobot would read its frames too."""
    root = recorded(tmp_path)
    assert push(root) == 0
    repository = online.dataset(REPO_ID)
    longer = {"data/chunk-000/file-001.parquet": b"", "notes.txt": b"mine"}
    repository.commit({**repository.files(), **longer}, "longer")
    assert push(root) == 0
    assert longer.keys() & repository.files().keys() == {"notes.txt"}


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Path], Path]:
    """Record a dataset with videos in place of images, as most have; return a way to copy it."""
    root = tmp_path_factory.mktemp("filmed") / "dataset"
    flags = ["--episodes=2", "--seed=7", "--image_size=32"]
    assert main(["record", f"--repo_id={REPO_ID}", f"--root={root}", *flags]) == 0
    return lambda folder: copy(root, folder / "dataset")


@pytest.mark.parametrize("message", DATASET_DAMAGES)
def test_a_broken_dataset_is_refused_in_one_line_before_anything_is_sent(
    message: str,
    online: LoopbackHub,
    filmed: Callable[[Path], Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    root = filmed(tmp_path)
    DATASET_DAMAGES[message](root)
    assert push(root) == 1
    error = capsys.readouterr().err.strip()
    assert message in error
    assert str(root) in error
    assert len(error.splitlines()) == 1
    assert TOKEN not in error
    assert online.requests == []


@pytest.mark.parametrize("name", ["", "../..", "a/b/c", "-x/y", "x", "a/b.git", "a/b--c", "mé/x", "me/x/"])
def test_what_is_no_name_on_the_hub_is_refused_by_every_flag_that_takes_one(
    name: str, online: LoopbackHub, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in (
        ["push", str(tmp_path)],
        ["record", "--episodes=1", f"--root={tmp_path / 'new'}"],
        ["convert", "pusht-zarr", str(tmp_path), f"--root={tmp_path / 'new'}"],
    ):
        assert main([*command, f"--repo_id={name}"]) == 1
        error = capsys.readouterr().err.strip()
        assert f"--repo_id={name!r} must have the form USER/NAME" in error, command
        assert len(error.splitlines()) == 1
    assert online.requests == []
