"""Depth that a policy reads: what is refused, and ZoeDepth on a tiny random model."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from transformers import ZoeDepthForDepthEstimation
from transformers.image_utils import PILImageResampling
from transformers.models.zoedepth.image_processing_zoedepth import ZoeDepthImageProcessor
from transformers.models.zoedepth.modeling_zoedepth import ZoeDepthDepthEstimatorOutput
from zoedepth_cases import make_zoedepth

from lerobot_bomb.vlm.depth import (
    ZoeDepth,
    load_zoedepth,
    observed_depth,
    observed_intrinsics,
    zoedepth_pixels,
)

KEY, K_KEY = "observation.depth.front", "observation.intrinsics.front"
K = torch.tensor([[[9.0, 0, 3.5], [0, 8, 2.5], [0, 0, 1]]]).repeat(2, 1, 1)


def changed(row: int, column: int, value: float) -> Tensor:
    """K whose last camera has another number."""
    other = K.clone()
    other[1, row, column] = value
    return other


# Observed


def test_depth_may_have_a_channel_and_holes() -> None:
    depth = torch.tensor([[[1.0, 0], [torch.inf, -1]]])
    expected = [[1, -9], [-9, -9]]
    for observed in (depth, depth[:, None], depth.double()):
        assert observed_depth({KEY: observed}, "front", (2, 2))[0].nan_to_num(-9).tolist() == expected


@pytest.mark.parametrize(
    ("depth", "message"),
    [
        (torch.ones(2, 6, 7), r"float32 of shape \(2, 6, 7\); expected .* \(batch, 6, 8\)"),
        (torch.ones(6, 8), r"of shape \(6, 8\)"),
        (torch.ones(2, 3, 6, 8), r"of shape \(2, 3, 6, 8\)"),
        (torch.ones(2, 6, 8, dtype=torch.int32), r"int32 .* expected float metres"),
        (torch.stack([torch.ones(6, 8), torch.full((6, 8), 1500)]), r"median of 1500: .* divide it by 1000"),
    ],
)
def test_wrong_depth_is_refused(depth: Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=rf"batch\['{KEY}'\].*{message}"):
        observed_depth({KEY: depth}, "front", (6, 8))


def test_missing_depth_is_said() -> None:
    with pytest.raises(KeyError, match=r"needs 'observation.depth.front'; the batch has .*--env.depth=true"):
        observed_depth({K_KEY: K}, "front", (6, 8))


@pytest.mark.parametrize(
    ("intrinsics", "message"),
    [
        (changed(0, 0, torch.nan), "numbers that are not finite"),
        (changed(1, 2, torch.inf), "numbers that are not finite"),
        (K[0], r"shape \(3, 3\); give the camera's 3x3 matrix"),
        (changed(0, 1, 0.5), "rectify"),
        (changed(1, 1, -8), "fy > 0"),
        (changed(2, 2, 0), r"\[0, 0, 1\]"),
    ],
)
def test_wrong_intrinsics_are_refused(intrinsics: Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=rf"batch\['{K_KEY}'\].*{message}"):
        observed_intrinsics({K_KEY: intrinsics}, "front", {})


def test_missing_intrinsics_are_said() -> None:
    with pytest.raises(
        KeyError, match=r"of no use without .*observation.intrinsics.front.*camera_intrinsics"
    ):
        observed_intrinsics({KEY: torch.ones(2, 6, 8)}, "front", {"wrist": K[0].tolist()})


def test_configured_intrinsics_go_before_observed_and_these_before_the_default() -> None:
    other = changed(0, 0, 5)[1].tolist()
    found = [
        observed_intrinsics(batch, "front", config, 7 * K[:1])[0, 0, 0]
        for batch, config in (({K_KEY: K}, {"front": other}), ({K_KEY: K}, {}), ({}, {}))
    ]
    assert found == [5, 9, 63]
    with pytest.raises(ValueError, match=r"--policy\.camera_intrinsics of 'front'"):
        observed_intrinsics({}, "front", {"front": [[1, 0], [0, 1]]})


# ZoeDepth


@pytest.fixture(scope="module")
def model() -> ZoeDepthForDepthEstimation:
    return make_zoedepth()


def images(size: int) -> Tensor:
    """(2, 3, size, size) in [-1, 1]."""
    return torch.rand(2, 3, size, size, generator=torch.Generator().manual_seed(0)) * 2 - 1


@pytest.mark.parametrize("size", [112, 224])
def test_zoedepth_reads_what_its_own_processor_makes(size: int) -> None:
    levels = ((images(size) + 1) * 127.5).byte()
    processor = ZoeDepthImageProcessor(
        size={"height": 384, "width": 384},
        keep_aspect_ratio=False,
        ensure_multiple_of=1,
        resample=PILImageResampling.BICUBIC,
    )
    expected = processor(list(levels), return_tensors="pt")["pixel_values"]
    assert torch.allclose(zoedepth_pixels(levels / 127.5 - 1), expected, atol=1e-5)


def test_estimated_depth_lies_on_the_pixels_that_it_belongs_to() -> None:
    """A model whose depth is the first channel of what it reads."""

    class Copy(nn.Module):
        def forward(self, pixel_values: Tensor) -> ZoeDepthDepthEstimatorOutput:
            return ZoeDepthDepthEstimatorOutput(predicted_depth=pixel_values[:, 0])  # type: ignore[arg-type]

    copy: Any = Copy()
    rows, columns = torch.meshgrid(torch.arange(224) / 40, torch.arange(224) / 50, indexing="ij")
    image = (rows.sin() * columns.cos()).expand(1, 3, 224, 224)
    inside = (..., slice(4, -4), slice(4, -4))  # at the border, the mirror makes a crease
    assert torch.allclose(ZoeDepth(copy)(image)[inside], image[:, 0][inside], atol=1e-3)


def test_zoedepth_is_frozen_and_does_not_depend_on_the_batch(model: ZoeDepthForDepthEstimation) -> None:
    policy = nn.Sequential(ZoeDepth(model)).train()
    pixels = images(112).requires_grad_()
    depth = policy(pixels)
    assert depth.shape == (2, 112, 112) and depth.std() > 0 and not depth.requires_grad
    assert policy(pixels).equal(depth)  # no layer is dropped
    assert torch.allclose(policy(pixels[1:])[0], depth[1], atol=1e-5)
    assert not any(parameter.requires_grad for parameter in policy.parameters())


def test_zoedepth_is_loaded_from_a_folder(model: ZoeDepthForDepthEstimation, tmp_path: Path) -> None:
    model.save_pretrained(tmp_path)
    assert load_zoedepth(str(tmp_path))(images(64)).equal(ZoeDepth(model)(images(64)))
    with pytest.raises(OSError, match=r"--policy\.depth_model_name=.*no model found"):
        load_zoedepth(str(tmp_path / "absent"))


def test_without_zoedepth_nothing_of_it_is_imported() -> None:
    code = (
        "import sys, lerobot_bomb.vlm.depth, lerobot_bomb.vlm.ego3d; sys.exit('transformers' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
