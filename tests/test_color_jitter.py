from dataclasses import astuple
from typing import Any

import pytest
import torch
from torchvision import transforms

from lerobot_bomb.vlm.color_jitter import ColorJitter

VLA0 = ColorJitter(0.2, 0.2, 0.2, 0.05)


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_it_changes_images_as_torchvision_does() -> None:
    images = torch.rand(6, 3, 20, 30, generator=generator())
    (changed,) = VLA0([images], generator())
    stock: Any = transforms.ColorJitter(*astuple(VLA0))
    draws = generator()
    for image, ours in zip(images, changed, strict=True):
        change = VLA0._draw(draws)
        order, factors = [index for index, _ in change], dict(change)
        stock.get_params = lambda *_, drawn=(order, *(factors[i] for i in range(4))): drawn
        assert torch.equal(stock(image), ours)
    assert not torch.equal(changed, images)


def test_factors_are_as_far_as_asked_and_every_order_is_drawn() -> None:
    draws = generator()
    changes = [VLA0._draw(draws) for _ in range(2000)]
    assert len({tuple(index for index, _ in change) for change in changes}) == 24
    for index, (low, high) in enumerate([(0.8, 1.2)] * 3 + [(-0.05, 0.05)]):
        factors = [dict(change)[index] for change in changes]
        assert min(factors) == pytest.approx(low, abs=1e-3) and max(factors) == pytest.approx(high, abs=1e-3)
        assert low <= min(factors) and max(factors) <= high


def test_a_samples_cameras_change_alike_and_samples_differently() -> None:
    """Even images, whatever their size, stay even."""
    colours = torch.tensor([0.5, 0.3, 0.1]).view(1, 3, 1, 1)
    first, second = VLA0([colours.expand(4, 3, 8, 8), colours.expand(4, 3, 6, 10)], generator())
    torch.testing.assert_close(first[..., 0, 0], second[..., 5, 9])
    assert len({tuple(colour) for colour in first[..., 0, 0].tolist()}) == 4


def test_what_is_zero_does_not_change() -> None:
    images = torch.rand(3, 3, 8, 8, generator=generator())
    (same,) = ColorJitter(0, 0, 0, 0)([images], generator())
    assert torch.equal(same, images)
    grey = images.mean(dim=1, keepdim=True).expand(3, 3, 8, 8)
    (turned,) = ColorJitter(0, 0, 0.3, 0.3)([grey], generator())
    torch.testing.assert_close(
        turned, grey, rtol=0, atol=1e-3
    )  # torchvision's weights of grey add up to 0.9999
    (dimmed,) = ColorJitter(0.5, 0, 0, 0)([images / 2], generator())
    shares = (dimmed / (images / 2)).flatten(1)
    torch.testing.assert_close(shares, shares[:, :1].expand_as(shares))
    assert len(shares[:, 0].unique()) == 3


def test_precision_does_not_depend_on_autocast() -> None:
    images = torch.rand(2, 3, 8, 8, generator=generator())
    with torch.autocast("cpu", dtype=torch.bfloat16):
        (inside,) = VLA0([images], generator())
    assert torch.equal(inside, VLA0([images], generator())[0])
