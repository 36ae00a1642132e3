"""`lerobot-bomb push`: what is published, what is refused, and what a push that is cut off leaves."""

import gzip
import hashlib
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from bomb_pusht_cases import pusht_row
from vla0_smol_cases import make_batch, make_policy

from hub.damage import (
    LOCAL,
    NORMALIZER,
    TOKENIZER,
    WEIGHTS,
    change_config,
    change_tensors,
    half_of_each,
    name_other_step,
    one_nan,
    remove,
    renamed,
    take_other_shape,
    take_other_weights,
    truncate,
    without_state,
)
from hub.server import TOKEN, LoopbackHub
from lerobot_bomb.bomb.board import task_id
from lerobot_bomb.bomb.environment import Environment
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.checkpoints.folder import read_config
from lerobot_bomb.checkpoints.identity import identity_of, identity_of_config, sha256_of
from lerobot_bomb.checkpoints.names import BLANK_IMAGES
from lerobot_bomb.checkpoints.shipped import shipped_checkpoint
from lerobot_bomb.commands.main import main
from lerobot_bomb.hub.evaluated import check_policy_of
from lerobot_bomb.hub.rates import FIGURE
from lerobot_bomb.results.bomb import EpisodeResult
from lerobot_bomb.results.groups import read_results
from lerobot_bomb.results.origin import PolicyIdentity
from lerobot_policy_bomb.vla0_smol.modeling_vla0_smol import Vla0SmolPolicy

REPO_ID = "me/x"


def result(seed: int, is_success: bool, policy: PolicyIdentity | None = None) -> str:
    return EpisodeResult(
        task_version="1.0",
        spec=EpisodeSpec(seed=seed),
        instruction="Place a black stone on the Go board at row 0, column 1.",
        task_id=task_id((0, 1), "black"),
        target=(0, 1),
        color="black",
        steps=20,
        progress=float(is_success),
        is_success=is_success,
        is_success_bomb_v0=is_success,
        failure=None if is_success else "dropped",
        stage="placed" if is_success else "lifted",
        placement_error_mm=1.0,
        nearest_intersection=(0, 1),
        collateral_mm=0.0,
        policy=policy,
    ).to_json()


def push(checkpoint: Path, *flags: str) -> int:
    return main(["push", str(checkpoint), f"--repo_id={REPO_ID}", *flags])


def test_one_commit_holds_all_that_is_needed_and_nothing_of_this_machine(
    online: LoopbackHub, checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results = tmp_path / "results.jsonl"
    results.write_text("\n".join(result(seed, is_success=seed < 1008) for seed in range(1000, 1010)))
    assert push(checkpoint, "--results", str(results), "--private") == 0
    repository = online.model(REPO_ID)
    assert len(repository.messages) == 1
    assert repository.is_private
    files = repository.files()
    assert {Path(name).suffix for name in files} == {".json", ".safetensors", ".md", ".svg"}
    assert not any(b"/data/" in content or TOKEN.encode() in content for content in files.values())
    assert TOKEN not in "".join(capsys.readouterr())
    card = files["README.md"].decode()
    metadata = yaml.safe_load(card.split("---\n")[1])
    assert "base_model" not in metadata
    assert "license" not in metadata
    assert "| 8/10 = 80.0 % [49.0, 94.3] |" in card  # Wilson's interval of 8 in 10
    for flag in (f"--policy.path={REPO_ID}", "--env.robot=scara", "--env.fps=10", "--env.image_size=256"):
        assert flag in card
    pulled = tmp_path / "pulled"
    pulled.mkdir()
    for name, content in files.items():
        (pulled / name).write_bytes(content)
    ours, theirs = (Vla0SmolPolicy.from_pretrained(folder) for folder in (checkpoint, pulled))
    batch = make_batch(make_policy(), 2)
    assert torch.equal(ours.predict_action_chunk(batch), theirs.predict_action_chunk(batch))


def test_the_figure_of_an_older_push_goes_with_its_rates(
    online: LoopbackHub, checkpoint: Path, tmp_path: Path
) -> None:
    results = tmp_path / "results.jsonl"
    results.write_text(result(1000, is_success=True))
    assert push(checkpoint, "--results", str(results)) == 0
    files = online.model(REPO_ID).files()
    assert files[FIGURE].startswith(b"<svg ")
    assert f"]({FIGURE})" in files["README.md"].decode()
    assert push(checkpoint) == 0
    files = online.model(REPO_ID).files()
    assert FIGURE not in files and FIGURE not in files["README.md"].decode()


def test_a_dry_run_prints_the_card_and_the_files_and_asks_nobody(
    online: LoopbackHub, checkpoint: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert push(checkpoint) == 0
    published = online.model(REPO_ID).files()
    online.requests.clear()
    capsys.readouterr()
    monkeypatch.setattr("lerobot_bomb.hub.upload.get_token", lambda: None)
    assert push(checkpoint, "--dry_run") == 0
    card = published.pop("README.md").decode()
    assert capsys.readouterr().out == "\n".join([card, *sorted(published), ""])
    assert online.requests == []
    with pytest.raises(SystemExit):
        push(checkpoint, "--dry")
    assert "unrecognized arguments: --dry" in capsys.readouterr().err


def test_results_of_other_weights_are_refused(
    online: LoopbackHub, checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ours = hashlib.sha256((checkpoint / WEIGHTS).read_bytes()).hexdigest()
    results = tmp_path / "results.jsonl"
    in_training = PolicyIdentity("vla0_smol", is_in_training=True)
    for policy in (PolicyIdentity("vla0_smol", "elsewhere", None, "a" * 64, "b" * 64), in_training):
        results.write_text(result(0, is_success=True, policy=policy))
        assert push(checkpoint, "--results", str(results)) == 1
        error = capsys.readouterr().err
        assert f"--results={results} is of vla0_smol " in error
        assert f"whose weights have the SHA-256 {ours}" in error
        assert error.count("\n") == 1
    assert online.requests == []
    results.write_text(
        result(0, is_success=True, policy=PolicyIdentity("vla0_smol", str(tmp_path), None, ours))
    )
    assert push(checkpoint, "--dry_run", "--results", str(results)) == 0
    card = capsys.readouterr().out
    assert "| perturbations=none | 1/1 = 100.0 % [20.7, 100.0] |" in card
    assert "target drawn; colour drawn; protocol 1.1, suite=place" in card
    assert str(tmp_path) not in card


@pytest.mark.parametrize("change", [{"settings_sha256": "b" * 64}, {"interventions": (BLANK_IMAGES,)}])
def test_results_with_other_settings_are_refused(
    change: dict[str, Any], checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = read_config(checkpoint, None)
    as_read = identity_of_config(config)
    as_built = identity_of(Vla0SmolPolicy.from_pretrained(checkpoint, config=config))
    results = tmp_path / "results.jsonl"
    for policy in (as_read, as_built):
        results.write_text(result(0, is_success=True, policy=policy))
        assert push(checkpoint, "--dry_run", "--results", str(results)) == 0
        capsys.readouterr()
    results.write_text(result(0, is_success=True, policy=replace(as_built, **change)))
    assert push(checkpoint, "--dry_run", "--results", str(results)) == 1
    assert "other --policy.* flags or processors were used" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["fdvla", "spatialvla_grid", "vla0_smol"])
def test_records_of_earlier_releases_are_the_shipped_checkpoints(name: str, tmp_path: Path) -> None:
    folder = shipped_checkpoint(name)
    ours = sha256_of(folder / WEIGHTS)
    with gzip.open(Path(__file__).parents[2] / "docs" / "media" / "shipped.jsonl.gz", "rt") as file:
        line = next(line for line in file if ours in line)
    (tmp_path / "results.jsonl").write_text(line)
    check_policy_of(tmp_path, read_results(tmp_path / "results.jsonl"), folder)


BROKEN = {
    "holds no model.safetensors, so it is no checkpoint": remove(WEIGHTS),
    "model.safetensors is truncated or no safetensors file": truncate(WEIGHTS),
    "which its policy_preprocessor.json needs": remove(TOKENIZER),
    "config.json is not JSON, or truncated": truncate("config.json"),
    "is not of the vla0_smol that config.json describes: it lacks backbone.": take_other_weights,
    "has shape (1,), not (": take_other_shape,
    f"would need the base model {LOCAL}": change_config(vlm_config=None),
    "the type 'act' is not one that lerobot-bomb pushes": change_config(type="act"),
    f"{WEIGHTS}: backbone.": change_tensors(WEIGHTS, one_nan),
    f"{NORMALIZER}: action.max": change_tensors(NORMALIZER, one_nan),
    "its statistics lack observation.state.": change_tensors(NORMALIZER, without_state),
    "no step 'bomb_unknown' is registered here": name_other_step,
    "the saved tokenizer cannot be read": change_tensors(TOKENIZER, half_of_each),
    "the state of bomb_task_tokenizer must be": change_tensors(TOKENIZER, renamed),
    "written by lerobot_bomb 99.0, newer than": change_config(package_version="99.0", new_flag=1),
}


@pytest.mark.parametrize("message", BROKEN)
def test_a_broken_checkpoint_is_refused_in_one_line_before_anything_is_sent(
    message: str, online: LoopbackHub, checkpoint: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    BROKEN[message](checkpoint)
    assert push(checkpoint) == 1
    error = capsys.readouterr().err.strip()
    assert message in error
    assert len(error.splitlines()) == 1
    assert online.requests == []


def test_a_card_states_no_rate_of_another_environment(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    environment = Environment("scara", "absolute", 10, 256, ("workspace", "wrist"), "1.0")
    change_config(environment=asdict(environment))(checkpoint)
    results = tmp_path / "results.jsonl"
    results.write_text(result(1000, is_success=True))
    assert push(checkpoint, "--dry_run", "--results", str(results)) == 1
    assert (
        f"--results={results} has an episode with control_mode=relative (seed 1000); this checkpoint was "
        "trained for control_mode=absolute"
    ) in capsys.readouterr().err


def test_results_on_pusht_are_for_checkpoints_that_were_not_trained_for_bomb(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    row = pusht_row(7, "none", 0.5, "timeout")
    results = tmp_path / "results.jsonl"
    results.write_text(json.dumps(row))
    push_results = ("--dry_run", "--results", str(results))
    assert push(checkpoint, *push_results) == 0
    card = capsys.readouterr().out
    assert "| perturbations=none | 0/1 = 0.0 % [0.0, 79.3] | 0.500 | 0.250 | timeout 1 |" in card
    assert "--env.type=bomb_pusht" in card
    other = PolicyIdentity("act", "elsewhere", None, "a" * 64, "b" * 64)
    results.write_text(json.dumps(row | {"policy": asdict(other)}))
    assert push(checkpoint, *push_results) == 1
    assert f"--results={results} is of act elsewhere" in capsys.readouterr().err
    environment = Environment("scara", "absolute", 10, 256, ("workspace", "wrist"), "1.0", "place")
    change_config(environment=asdict(environment))(checkpoint)
    results.write_text(json.dumps(row))
    assert push(checkpoint, *push_results) == 1
    assert (
        f"--results={results} has an episode of --env.type=bomb_pusht (seed 7); this checkpoint was trained "
        "for BOMB, task version 1.0, suite place"
    ) in capsys.readouterr().err


def test_no_token_a_wrong_one_and_no_hub(
    online: LoopbackHub, checkpoint: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from huggingface_hub import constants

    errors = []
    monkeypatch.setenv("HF_TOKEN", "hf_wrong")
    assert push(checkpoint) == 1
    errors.append(capsys.readouterr().err)
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    assert push(checkpoint) == 1
    errors.append(capsys.readouterr().err)
    monkeypatch.delenv("HF_TOKEN")
    monkeypatch.setattr("lerobot_bomb.hub.upload.get_token", lambda: None)
    assert push(checkpoint) == 1
    errors.append(capsys.readouterr().err)
    parts = ("Invalid username or password", "http://127.0.0.1:9 cannot be reached", "run `hf auth login`")
    for error, part in zip(errors, parts, strict=True):
        assert part in error
        assert "hf_wrong" not in error
        assert len(error.strip().splitlines()) == 1
    assert online.repositories == {}


def test_a_push_that_is_cut_off_anywhere_leaves_nothing_or_everything(
    online: LoopbackHub, checkpoint: Path
) -> None:
    assert push(checkpoint) == 0
    whole, num_requests = online.model(REPO_ID).files(), len(online.requests)
    assert num_requests >= 7
    seen = set()
    for last in range(num_requests):
        online.repositories.clear()
        online.blobs.clear()
        online.requests.clear()

        def cut(_: str, last: int = last) -> None:
            if len(online.requests) > last:
                raise ConnectionAbortedError

        online.before = cut
        push(checkpoint)
        repository = online.repositories.get(f"models/{REPO_ID}")
        files = {} if repository is None else repository.files()
        assert files in ({}, whole)
        seen.add(bool(files))
    assert False in seen


@pytest.mark.parametrize("token", ["hf_abc\nsecret", "hf_abc\x01secret", "hf_abc secret", "hf_äbcsecret"])
def test_a_token_that_no_header_can_hold_is_never_shown(
    token: str,
    online: LoopbackHub,
    checkpoint: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Check our push, and what LeRobot's commands ask the Hub."""
    from huggingface_hub import hf_hub_download

    monkeypatch.setenv("HF_TOKEN", token)
    assert push(checkpoint) == 1
    flags = ["--policy.type=vla0_smol", "--dataset.repo_id=me/elsewhere", f"--output={tmp_path / 'new'}"]
    assert main(["checkpoint", "init", *flags]) == 1
    errors = capsys.readouterr().err.strip().splitlines()
    with pytest.raises(ValueError) as raised:
        hf_hub_download("me/x", "config.json")
    chain, seen = raised.value, []
    while chain is not None:
        seen.append(str(chain))
        chain = chain.__context__
    for text in (*errors, *seen):
        assert "secret" not in text
    assert len(errors) == 2
    for text in (*errors, seen[0]):
        assert "contains a" in text
        assert "hf auth login" in text
    assert online.requests == []
