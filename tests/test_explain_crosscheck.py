"""Explanations beside the tools that others use: captum's occlusion, nnsight's interventions.

Neither knows prompts or flow policies, so the package itself uses none of them.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from captum.attr import Occlusion
from explain_cases import NAMES, WORKSPACE, ask, loaded, without_image
from torch import Tensor

from lerobot_bomb.explain.activations import all_heads
from lerobot_bomb.explain.images import filling, patch_masks
from lerobot_bomb.explain.restoration import Corruption

pytestmark = pytest.mark.usefixtures("loaded_policies")

GRID = 4
CALLED_ONCE = ("spatialvla_grid", "vla0_smol")  # each layer, in a score
SCRIPT = Path(__file__).with_name("explain_by_nnsight.py")


@pytest.mark.parametrize("name", NAMES)
def test_patches_are_captums_occlusion(name: str) -> None:
    question = ask(loaded(name))
    (image,) = question.observation[WORKSPACE]
    filled, side = filling(image, "mean", 1.0), image.shape[-1] // GRID

    def score(images: Tensor) -> Tensor:
        rows = question.encode({WORKSPACE: images}, len(images))
        return question.policy.score(rows, question.answer)

    with torch.no_grad():
        expected = Occlusion(score).attribute(
            image[None],
            sliding_window_shapes=(3, side, side),
            strides=(3, side, side),
            baselines=filled[None].contiguous(),
            perturbations_per_eval=4,
        )
    effects = question.effects_of_masks(WORKSPACE, patch_masks(GRID, *image.shape[1:]), filled)
    torch.testing.assert_close(
        effects.view(GRID, GRID), expected[0, 0, ::side, ::side].float(), rtol=1e-5, atol=1e-5 * GRID
    )


@pytest.fixture(scope="module")
def by_nnsight() -> dict[str, list[list[float]]]:
    """Scores of policies with each head put back: {name: (layers, heads)}."""
    printed = subprocess.run(
        [sys.executable, SCRIPT, *CALLED_ONCE],
        check=True,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(SCRIPT.parent)},
    ).stdout
    return json.loads(printed.splitlines()[-1])


@pytest.mark.long
@pytest.mark.parametrize("name", CALLED_ONCE)
def test_heads_are_what_nnsight_puts_back(name: str, by_nnsight: dict[str, list[list[float]]]) -> None:
    question = ask(loaded(name))
    corruption = Corruption(question, without_image(question))
    scores = corruption.restore([[unit] for unit in all_heads(question.policy.layers)]).scores
    expected = torch.tensor(by_nnsight[name]).flatten()
    torch.testing.assert_close(scores, expected, rtol=1e-5, atol=1e-5)
