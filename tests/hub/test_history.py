"""History of a checkpoint: its trainings, as files of this machine tell them."""

import hashlib
import json
from pathlib import Path
from typing import Any

import pytest
from vla0_smol_cases import make_config

from lerobot_bomb.checkpoints.shipped import shipped_checkpoint
from lerobot_bomb.checkpoints.training import read_train_config
from lerobot_bomb.data.facts import DatasetFacts
from lerobot_bomb.hub.history import History

SHIPPED_SHA256 = "70361f943f45e54646a737209cade936a7e9ba143cb938b266413515be0a9162"
INFO = {"total_episodes": 3, "total_frames": 60, "fps": 10}
NONE_KNOWN = ["not known"] * 4
START = "All weights"


def config(num_batches: int, parent: object = None) -> Any:
    return make_config(trained_batches=num_batches, pretrained_path=parent)


def train_config(steps: int, dataset: str = "me/d", output_dir: str | None = "outputs/x") -> dict[str, Any]:
    return {
        "steps": steps, "batch_size": 4, "seed": 3, "dataset": {"repo_id": dataset, "root": "gone"},
        "output_dir": output_dir,
    }  # fmt: skip


def write_parent(folder: Path, num_batches: int, steps: int, parent: object = None) -> Path:
    folder.mkdir()
    values = {"type": "vla0_smol", "trained_batches": num_batches, "pretrained_path": parent and str(parent)}
    (folder / "config.json").write_text(json.dumps(values))
    (folder / "train_config.json").write_text(json.dumps(train_config(steps, "me/first")))
    (folder / "model.safetensors").write_bytes(b"weights")
    return folder


def rows(history: History) -> list[list[str]]:
    lines = history.table(frozenset()).splitlines()
    assert lines[0].count("|") == lines[1].count("|") == 7
    return [line.strip("| ").split(" | ") for line in lines[2:]]


def history_of(num_batches: int, parent: object, steps: int, **options: Any) -> History:
    return History.of(config(num_batches, parent), train_config(steps, **options), None)


def test_one_training_from_the_start() -> None:
    data = ["`me/d`, a name on the machine of the training", "not known", "4", "3", "this checkpoint"]
    assert rows(history_of(1000, None, 1000)) == [["1 to 1,000", *data]]
    assert rows(history_of(500, None, 1000)) == [["1 to 500", *data]]  # saved before the end
    assert history_of(1000, None, 1000).start is None


def test_the_shipped_checkpoint_was_trained_before_its_last_training() -> None:
    folder = shipped_checkpoint("vla0_smol")
    values = json.loads((folder / "config.json").read_text())
    history = History.of(config(values["trained_batches"]), read_train_config(folder), None)
    first, last = rows(history)
    assert first == ["1 to 10,000", *NONE_KNOWN, "not known"]
    assert last[0] == "10,001 to 30,000" and last[-1] == "this checkpoint"
    assert history.start == "CHECKPOINT"


def test_a_parent_is_followed_with_its_hash(tmp_path: Path) -> None:
    first = write_parent(tmp_path / "first", 10, 10)
    second = write_parent(tmp_path / "second", 30, 20, parent=first)
    history = history_of(100, second, 70)
    sha256 = hashlib.sha256(b"weights").hexdigest()
    ended = f"a checkpoint without a name on the Hub, SHA-256 `{sha256}`"
    assert [row[0] for row in rows(history)] == ["1 to 10", "11 to 30", "31 to 100"]
    assert [row[-1] for row in rows(history)] == [ended, ended, "this checkpoint"]
    assert history.datasets == ["me/d", "me/first"]
    assert history.start == "CHECKPOINT"
    assert str(tmp_path) not in history.table(frozenset())


def test_a_shipped_parent_has_its_name() -> None:
    history = history_of(30050, shipped_checkpoint("vla0_smol"), 50)
    assert [row[0] for row in rows(history)] == ["1 to 10,000", "10,001 to 30,000", "30,001 to 30,050"]
    assert rows(history)[1][-1] == f"`bomb:vla0_smol`, SHA-256 `{SHIPPED_SHA256}`"
    assert history.start == "bomb:vla0_smol"


@pytest.mark.parametrize(
    ("parent", "ended", "start"),
    [("me/base", "`me/base`", "me/base"), ("/gone/x", "a checkpoint that is not here", "CHECKPOINT")],
)
def test_a_parent_that_is_not_here(parent: str, ended: str, start: str) -> None:
    history = history_of(300, parent, 200)
    assert [rows(history)[0], rows(history)[1][0]] == [["1 to 100", *NONE_KNOWN, ended], "101 to 300"]
    assert history.start == start
    cut_short = history_of(150, parent, 200)  # how many came before is not known
    assert [row[0] for row in rows(cut_short)] == ["before", "up to 150"]


def test_a_published_copy_that_names_no_parent_may_have_had_one() -> None:
    history = history_of(150, None, 200, output_dir=None)
    assert [row[0] for row in rows(history)] == ["before", "up to 150"]
    assert history.start == "CHECKPOINT"


def test_a_resumed_training_names_itself(tmp_path: Path) -> None:
    itself = write_parent(tmp_path / "last", 200, 200, parent=tmp_path / "last")
    assert [row[0] for row in rows(history_of(200, itself, 200))] == ["1 to 200"]
    half = write_parent(tmp_path / "half", 100, 200)
    assert [row[0] for row in rows(history_of(200, half, 200))] == ["1 to 100", "101 to 200"]


def test_without_the_config_of_the_training_nothing_is_known() -> None:
    history = History.of(config(70), {}, None)
    assert rows(history) == [["1 to 70", *NONE_KNOWN, "this checkpoint"]]


def test_what_the_dataset_shows() -> None:
    facts = DatasetFacts(INFO, {}, [{"suite": "place", "seed": 1, "perturbations": "camera:2|x`"}])
    (row,) = rows(History.of(config(7), train_config(7), facts))
    assert row[1] == "`me/d`, a name on the machine of the training: 3 episodes, 60 frames at 10 Hz"
    assert row[2] == r"camera:2\|x\`"


def write_data(root: Path, seed: int) -> dict[str, str]:
    """Write what a recording of two seeds says; return a training's `dataset`."""
    (root / "meta").mkdir(parents=True)
    (root / "meta" / "info.json").write_text(json.dumps(INFO))
    recording = {"task": "place", "task_ids": [], "perturbations": ["none"], "seed": seed}
    bomb = {"recording": recording, "num_episodes": 2, "num_frames": 60, "failures": []}
    (root / "meta" / "bomb.json").write_text(json.dumps(bomb))
    return {"repo_id": "me/d", "root": str(root)}


def test_seeds_are_those_of_all_trainings(tmp_path: Path) -> None:
    first = write_parent(tmp_path / "first", 10, 10)
    second = write_parent(tmp_path / "second", 30, 20, parent=first)
    assert History.read(second).is_whole and History.read(second).seeds is None  # the data are gone
    for folder, steps, seed in ((first, 10, 3), (second, 20, 90)):
        told = {**train_config(steps), "dataset": write_data(tmp_path / f"data{seed}", seed)}
        (folder / "train_config.json").write_text(json.dumps(told))
    assert History.read(second).seeds == [3, 4, 90, 91]
    (first / "config.json").unlink()
    assert not History.read(second).is_whole and History.read(second).seeds is None
