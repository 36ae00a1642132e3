"""Interventions on a checkpoint's preprocessor."""

from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.processor import DataProcessorPipeline, batch_to_transition
from safetensors.torch import load_file
from vla0_smol_cases import STATS, WORKSPACE, WRIST, make_policy, raw_batch

from lerobot_bomb.explain.interventions import PREPROCESSOR_FILE, BlankImages, ReplaceTasks, intervene
from lerobot_policy_bomb.vla0_smol import make_vla0_smol_pre_post_processors

SWAPPED = {"to the left": "to the right", "to the right": "to the left"}


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("policy") / "checkpoint"
    policy = make_policy()
    policy.save_pretrained(folder)
    for processor in make_vla0_smol_pre_post_processors(policy.config, STATS):
        processor.save_pretrained(folder)
    return folder


def preprocess(folder: Path, batch: dict[str, Any]) -> dict[str, Any]:
    # as lerobot-eval loads it
    pipeline = DataProcessorPipeline.from_pretrained(
        folder, config_filename=PREPROCESSOR_FILE, to_transition=batch_to_transition
    )
    return pipeline(batch)


def tensors(batch: dict[str, Any]) -> dict[str, torch.Tensor]:
    return {key: value for key, value in batch.items() if isinstance(value, torch.Tensor)}


def test_blank_images_change_the_cameras_and_nothing_else(checkpoint: Path, tmp_path: Path) -> None:
    intervene(checkpoint, [BlankImages()], tmp_path / "blank")
    usual = tensors(preprocess(checkpoint, raw_batch(3)))
    blank = tensors(preprocess(tmp_path / "blank", raw_batch(3)))
    assert usual.keys() == blank.keys()
    for key in usual:
        expected = torch.zeros_like(usual[key]) if key in (WORKSPACE, WRIST) else usual[key]
        assert torch.equal(blank[key], expected), key


def test_replaced_tasks_are_what_the_policy_reads(checkpoint: Path, tmp_path: Path) -> None:
    intervene(checkpoint, [ReplaceTasks(SWAPPED)], tmp_path / "swapped")
    batch = {**raw_batch(2), "task": ["to the left", "to the right"]}
    swapped = preprocess(tmp_path / "swapped", batch)["observation.language.tokens"]
    usual = preprocess(checkpoint, batch)["observation.language.tokens"]
    assert not torch.equal(swapped, usual)
    expected = preprocess(checkpoint, {**batch, "task": ["to the right", "to the left"]})
    assert torch.equal(swapped, expected["observation.language.tokens"])


def test_a_single_task_may_be_a_text() -> None:
    changed = ReplaceTasks(SWAPPED).complementary_data({"task": "to the left"})
    assert changed == {"task": "to the right"}


def test_a_task_without_a_replacement_is_an_error(checkpoint: Path, tmp_path: Path) -> None:
    intervene(checkpoint, [ReplaceTasks(SWAPPED)], tmp_path / "swapped")
    with pytest.raises(ValueError, match=r"'upwards' has no replacement.*to the left"):
        preprocess(tmp_path / "swapped", {**raw_batch(2), "task": ["to the left", "upwards"]})


def test_weights_and_config_stay_as_they_are(checkpoint: Path, tmp_path: Path) -> None:
    intervene(checkpoint, [BlankImages()], tmp_path / "blank")
    usual, blank = (load_file(folder / "model.safetensors") for folder in (checkpoint, tmp_path / "blank"))
    assert len(usual) > 10
    assert usual.keys() == blank.keys()
    assert all(torch.equal(usual[key], blank[key]) for key in usual)
    for name in ("config.json", "policy_postprocessor.json"):
        assert (checkpoint / name).read_text() == (tmp_path / "blank" / name).read_text()


@pytest.mark.parametrize("steps", [[], [BlankImages], BlankImages])
def test_what_is_no_step_is_refused_before_anything_is_written(
    steps: Any, checkpoint: Path, tmp_path: Path
) -> None:
    with pytest.raises((ValueError, TypeError)):
        intervene(checkpoint, steps, tmp_path / "x")
    assert not (tmp_path / "x").exists()


def test_replacements_must_say_something() -> None:
    with pytest.raises(ValueError, match="must map instructions"):
        ReplaceTasks({})


def test_interventions_add_up(checkpoint: Path, tmp_path: Path) -> None:
    intervene(checkpoint, [BlankImages()], tmp_path / "blank")
    intervene(tmp_path / "blank", [ReplaceTasks(SWAPPED)], tmp_path / "both")
    observation = preprocess(tmp_path / "both", {**raw_batch(1), "task": ["to the left"]})
    expected = preprocess(checkpoint, {**raw_batch(1), "task": ["to the right"]})
    assert observation[WRIST].abs().max() == 0
    assert torch.equal(observation["observation.state"], expected["observation.state"])
    key = "observation.language.tokens"
    assert torch.equal(observation[key], expected[key])


def test_what_is_no_checkpoint_or_exists_is_named(checkpoint: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"nowhere holds no policy_preprocessor.json"):
        intervene(tmp_path / "nowhere", [BlankImages()], tmp_path / "x")
    with pytest.raises(ValueError, match=f"{tmp_path} exists already"):
        intervene(checkpoint, [BlankImages()], tmp_path)
