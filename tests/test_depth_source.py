"""Depth of a converted checkpoint: its source can be changed, and what gets no gradient is frozen."""

from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from published_spatialvla import (
    CAMERA,
    cells_of,
    converted,
    load,
    make_original,
    observations,
    write_published,
)
from safetensors.torch import load_file

from lerobot_policy_bomb.spatialvla_grid.modeling_spatialvla_grid import SpatialvlaGridPolicy

DEPTH, INTRINSICS = "observation.depth.image", "observation.intrinsics.image"


@pytest.fixture(scope="module")
def original() -> SpatialvlaGridPolicy:
    return make_original(0)


@pytest.fixture(scope="module")
def checkpoint(original: SpatialvlaGridPolicy, tmp_path_factory: pytest.TempPathFactory) -> Path:
    parent = tmp_path_factory.mktemp("published")
    return converted(write_published(original, parent / "tiny"), parent / "checkpoint")


def test_depth_may_be_observed_instead(checkpoint: Path, original: SpatialvlaGridPolicy) -> None:
    policy, preprocessor, _ = load(checkpoint, depth_source="observation")
    assert policy.zoedepth is None and {DEPTH, INTRINSICS} < set(policy.config.input_features or {})
    batch = preprocessor(observations(2))
    with pytest.raises(KeyError, match=f"depth_source=observation needs '{DEPTH}'.*--env.depth=true"):
        policy.predict_action_chunk(batch)
    assert original.zoedepth is not None
    batch[DEPTH] = original.zoedepth(2 * batch[CAMERA] - 1)
    with pytest.raises(KeyError, match=f"of no use without .*{INTRINSICS}"):
        policy.predict_action_chunk(batch)
    # counted from the first pixel's centre
    batch[INTRINSICS] = torch.tensor([[[218.2558, 0, 111.32535], [0, 291.00773, 111.28767], [0, 0, 1]]] * 2)
    assert torch.equal(cells_of(policy, batch), cells_of(original, batch))


@pytest.mark.parametrize("is_known", [True, False])
def test_depth_may_be_estimated_again_after_a_training_without(
    is_known: bool, checkpoint: Path, tmp_path: Path
) -> None:
    """Check that ``depth_model_name`` stands in for missing weights; its architecture may be known."""
    blind, preprocessor, _ = load(checkpoint, depth_source="none")
    if not is_known:
        blind.config.depth_config = None
    blind.save_pretrained(tmp_path / "blind")
    assert not any(
        name.startswith("zoedepth") for name in load_file(tmp_path / "blind" / "model.safetensors")
    )

    def estimating(name: Path) -> SpatialvlaGridPolicy:
        flags = ["--depth_source=zoedepth", f"--depth_model_name={name}"]
        config: Any = PreTrainedConfig.from_pretrained(tmp_path / "blind", cli_overrides=flags)
        return SpatialvlaGridPolicy.from_pretrained(tmp_path / "blind", config=config)

    with pytest.raises(OSError, match=r"--policy\.depth_model_name=.*no model found.*depth_source=obs"):
        estimating(tmp_path / "absent")
    before, _, _ = load(checkpoint)
    assert before.zoedepth is not None
    before.zoedepth.model.save_pretrained(tmp_path / "zoedepth")
    again = estimating(tmp_path / "zoedepth")
    again.save_pretrained(tmp_path / "again")
    batch = preprocessor(observations(2))
    for policy in (again, SpatialvlaGridPolicy.from_pretrained(tmp_path / "again")):
        assert torch.equal(cells_of(policy, batch), cells_of(before, batch))


@pytest.mark.parametrize("loss_vocab", ["slot", "full"])
@pytest.mark.parametrize("depth_source", ["zoedepth", "none"])
def test_all_that_is_trained_gets_a_gradient(depth_source: str, loss_vocab: str, checkpoint: Path) -> None:
    policy, preprocessor, _ = load(checkpoint, depth_source=depth_source, loss_vocab=loss_vocab)
    batch = preprocessor(observations(2) | {"action": torch.zeros(2, 4, 7)})
    policy.train()(batch)[0].backward()
    idle = [
        name
        for name, parameter in policy.named_parameters()
        if parameter.requires_grad and (parameter.grad is None or not parameter.grad.any())
    ]
    assert not idle
    assert policy.backbone.vlm.lm_head.weight.requires_grad == (loss_vocab == "full")
