"""`lerobot-train --policy.push_to_hub=true` at its end: one commit, whole or nothing, and nothing private."""

import copy
import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest
import torch
from huggingface_hub.errors import HfHubHTTPError
from lerobot.common import train_utils
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.policies import make_pre_post_processors
from vla0_smol_cases import STATS, make_policy

from hub.damage import LOCAL
from hub.server import TOKEN, LoopbackHub, Repository

REPO_ID = "me/x"
Files = dict[str, bytes]


@dataclass(frozen=True)
class Training:
    """Training at its end: what `lerobot-train` holds then."""

    cfg: TrainPipelineConfig
    policy: Any
    processors: tuple[Any, Any]

    @classmethod
    def ended(cls, folder: Path, scale: float, *, saves: bool = True) -> "Training":
        """Build an ended training with statistics and weights of `scale`."""
        policy = make_policy(repo_id=REPO_ID, pretrained_path=folder / "base")
        with torch.no_grad():
            for parameter in policy.parameters():
                parameter *= scale
        stats = {key: {name: scale * tensor for name, tensor in each.items()} for key, each in STATS.items()}
        policy.config.vlm_model_name = "nano"
        processors = make_pre_post_processors(policy.config, dataset_stats=stats)
        policy.config.vlm_model_name = LOCAL
        dataset = DatasetConfig("me/d", root=str(folder / "dataset"))
        cfg = TrainPipelineConfig(dataset, policy=policy.config, output_dir=folder / "out")
        if saves:
            last = folder / "out" / "checkpoints" / "last" / "pretrained_model"
            for each in (policy, cfg, *processors):
                each.save_pretrained(last)
        return cls(cfg, policy, processors)

    def push(self) -> None:
        """Push as `lerobot_train` does."""
        publish: Any = getattr(train_utils, "publish_trained_model", None)  # LeRobot 0.6.2
        if publish is not None:
            publish(self.cfg, self.policy, *self.processors, None)
            return
        self.policy.push_model_to_hub(self.cfg, state_dict=None, dataset_meta=None)
        for processor in self.processors:
            processor.push_to_hub(REPO_ID)


def cut_before(hub: LoopbackHub, last: int) -> Callable[[str], None]:
    def cut(_: str) -> None:
        if len(hub.requests) > last:
            raise ConnectionAbortedError

    return cut


def left_by_cuts(hub: LoopbackHub, old: Training, new: Training) -> tuple[Files, Files, list[Files]]:
    """The repository after the old push and after the new one, and after each way to cut the latter off."""
    old.push()
    then = copy.deepcopy(hub.repositories)
    before = hub.model(REPO_ID).files()
    hub.requests.clear()
    new.push()
    whole, num_requests = hub.model(REPO_ID).files(), len(hub.requests)
    left = []
    for last in range(num_requests):
        hub.repositories = copy.deepcopy(then)
        hub.requests.clear()
        hub.blobs.clear()
        hub.before = cut_before(hub, last)
        with pytest.raises((RuntimeError, httpx.HTTPError, HfHubHTTPError)):
            new.push()
        left.append(hub.model(REPO_ID).files())
    return before, whole, left


def test_a_push_is_one_commit_without_paths_of_this_machine(online: LoopbackHub, tmp_path: Path) -> None:
    training = Training.ended(tmp_path, 1.0)
    training.push()
    repository = online.model(REPO_ID)
    assert len(repository.messages) == 1
    files = repository.files()
    assert {Path(name).suffix for name in files} == {".json", ".safetensors", ".md"}
    last = tmp_path / "out" / "checkpoints" / "last" / "pretrained_model"
    for path in (*last.glob("policy_*"), last / "model.safetensors"):
        assert files[path.name] == path.read_bytes()
    for content in files.values():
        assert not any(private in content for private in (str(tmp_path).encode(), b"/data/"))


def test_the_hub_is_asked_whether_it_has_the_dataset(online: LoopbackHub, tmp_path: Path) -> None:
    Training.ended(tmp_path / "first", 1.0).push()
    card = online.model(REPO_ID).files()["README.md"].decode()
    assert "datasets:" not in card and "--dataset.repo_id=me/d" not in card
    online.repositories.setdefault("datasets/me/d", Repository()).commit({"meta/info.json": b"{}"}, "data")
    Training.ended(tmp_path / "second", 1.0).push()
    card = online.model(REPO_ID).files()["README.md"].decode()
    assert "datasets:\n- me/d\n" in card and "--dataset.repo_id=me/d" in card


@pytest.mark.long
def test_a_push_that_is_cut_off_leaves_the_old_one_or_the_new_one(
    online: LoopbackHub, tmp_path: Path
) -> None:
    old, new = (Training.ended(tmp_path / name, scale) for name, scale in (("old", 1.0), ("new", 2.0)))
    before, whole, left = left_by_cuts(online, old, new)
    assert before["model.safetensors"] != whole["model.safetensors"]
    assert all(files in (before, whole) for files in left)
    assert before in left
    assert whole in left  # LeRobot's own commits of the processors have nothing to add


@pytest.mark.long
def test_without_a_checkpoint_a_cut_leaves_no_processors_of_an_older_push(
    online: LoopbackHub, tmp_path: Path
) -> None:
    old = Training.ended(tmp_path / "old", 1.0)
    new = Training.ended(tmp_path / "new", 2.0, saves=False)
    before, whole, left = left_by_cuts(online, old, new)
    names = [name for name in whole if name.startswith("policy_")]
    assert len(names) == 5
    for files in left:
        is_new = all(files[name] == whole[name] for name in names if name in files)
        assert files == before or (files["model.safetensors"] == whole["model.safetensors"] and is_new)
    assert any("policy_preprocessor.json" not in files for files in left)


@pytest.mark.parametrize("source", ["environment", "file"])
def test_the_token_goes_into_the_authorization_alone(
    source: str,
    online: LoopbackHub,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    if source == "file":
        from huggingface_hub import constants

        stored = tmp_path / "token"
        stored.write_text(TOKEN)
        monkeypatch.delenv("HF_TOKEN")
        monkeypatch.setattr(constants, "HF_TOKEN_PATH", str(stored))
    with caplog.at_level(logging.INFO):
        Training.ended(tmp_path / "run", 1.0).push()
    assert len(online.model(REPO_ID).files()) == 9  # taken, so the token was given
    assert online.betrayals == []
    assert TOKEN not in "".join([*capsys.readouterr(), caplog.text, *online.cards])
    written = [path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file()]
    assert not any(TOKEN.encode() in each for each in [*written, *online.model(REPO_ID).files().values()])
