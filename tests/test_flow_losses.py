"""Losses of velocity and noise heads: literal numbers, what is masked or detached."""

import math
from typing import Any

import pytest
import torch
from flow_cases import CONSISTENCY_ONLY, random_point

from lerobot_bomb.flow.losses import check_objective, consistency_residual, joint_loss, masked_mean
from lerobot_bomb.flow.path import path_point

KEPT = torch.ones(1, 1, dtype=torch.bool)
POINT = path_point(torch.tensor([[[1.0, -0.5]]]), torch.tensor([[[0.2, 0.4]]]), torch.tensor([0.25]))
VELOCITY, NOISE = torch.tensor([[[0.9, -0.7]]]), torch.tensor([[[0.1, 0.5]]])


# Value


def test_terms_and_their_sum() -> None:
    loss, metrics = joint_loss(VELOCITY, NOISE, POINT, KEPT)
    assert loss.item() == pytest.approx(0.03640625)
    assert {name: metric.item() for name, metric in metrics.items()} == pytest.approx(
        {
            "flow_loss": 0.025,
            "denoise_loss": 0.01,
            "consistency_loss": 0.0140625,
            "consistency_residual_rms": math.sqrt(0.0140625),
        }
    )


def test_residual_of_the_heads() -> None:
    residual = consistency_residual(VELOCITY, NOISE, POINT)
    torch.testing.assert_close(residual, torch.tensor([[[-0.075, 0.15]]]))
    assert consistency_residual(POINT.velocity, POINT.noise, POINT).abs().max() < 1e-7


def test_every_term_has_a_weight() -> None:
    loss, _ = joint_loss(
        VELOCITY,
        NOISE,
        POINT,
        KEPT,
        flow_loss_weight=2.0,
        denoise_loss_weight=3.0,
        consistency_loss_weight=4.0,
    )
    assert loss.item() == pytest.approx(2 * 0.025 + 3 * 0.01 + 4 * 0.0140625)


@pytest.mark.parametrize("off", [{"consistency": "none"}, {"consistency_loss_weight": 0.0}])
def test_without_consistency_its_residual_is_still_measured(off: dict[str, Any]) -> None:
    loss, metrics = joint_loss(VELOCITY, NOISE, POINT, KEPT, **off)
    assert loss.item() == pytest.approx(0.035)
    assert metrics["consistency_residual_rms"].item() == pytest.approx(math.sqrt(0.0140625))
    assert "consistency_loss" not in metrics


def test_one_head() -> None:
    loss, metrics = joint_loss(VELOCITY, None, POINT, KEPT, consistency="none")
    assert loss.item() == pytest.approx(0.025) and set(metrics) == {"flow_loss"}
    loss, metrics = joint_loss(None, NOISE, POINT, KEPT, consistency_loss_weight=0)
    assert loss.item() == pytest.approx(0.01) and set(metrics) == {"denoise_loss"}


# Padding


def test_mean_over_kept_elements() -> None:
    values = torch.tensor([[[1.0, 3], [10, 20]], [[5, 7], [9, 11]], [[30, 40], [50, 60]]])
    kept = torch.tensor([[True, False], [True, True], [False, False]])
    assert masked_mean(values, kept).item() == 6  # not of the rows' means
    assert masked_mean(values, kept, "none").tolist() == [2, 8, 0]


def test_loss_of_each_row() -> None:
    point = random_point(3)
    velocity, noise = torch.randn(2, 3, 5, 3, generator=torch.Generator().manual_seed(1))
    kept = torch.tensor([[True] * 5, [True] * 2 + [False] * 3, [True] + [False] * 4])
    losses, metrics = joint_loss(velocity, noise, point, kept, reduction="none")
    for row in range(3):
        alone = path_point(
            *(tensor[row : row + 1] for tensor in (point.noise + point.velocity, point.noise, point.tau))
        )
        expected, _ = joint_loss(velocity[row : row + 1], noise[row : row + 1], alone, kept[row : row + 1])
        torch.testing.assert_close(losses[row], expected)
    mean, metrics_of_mean = joint_loss(velocity, noise, point, kept)
    torch.testing.assert_close(mean, (losses * torch.tensor([5, 2, 1]) / 8).sum())
    assert metrics == metrics_of_mean


@pytest.mark.parametrize("consistency", ["linear", "energy_vjp"])
def test_padded_targets_change_neither_loss_nor_gradients(consistency: str) -> None:
    generator = torch.Generator().manual_seed(0)
    clean, noise, other = torch.randn(3, 2, 4, 3, generator=generator)
    kept = torch.tensor([[True, True, True, False], [True, False, False, False]])
    results = []
    for actions in (clean, torch.where(kept[..., None], clean, 1000 * other)):
        weights = torch.tensor([0.7, -0.4], requires_grad=True)
        point = path_point(actions, noise, torch.tensor([0.3, 0.8]))
        point.actions.requires_grad_()
        heads = weights[0] * point.actions, weights[1] * point.actions**2
        loss, _ = joint_loss(*heads, point, kept, consistency=consistency)
        loss.backward()
        results.append((loss.detach(), weights.grad))
    assert results[0][0].equal(results[1][0])
    assert results[0][1].equal(results[1][1]) and results[0][1].all()


@pytest.mark.parametrize("reduction", ["mean", "none"])
@pytest.mark.parametrize("consistency", ["linear", "energy_vjp"])
def test_nothing_kept_is_a_loss_of_zero_that_trains_nothing(consistency: str, reduction: str) -> None:
    point = random_point(2)
    weight = torch.tensor(2.0, requires_grad=True)
    kept = torch.zeros(2, 5, dtype=torch.bool)
    heads = weight * point.actions, weight * point.actions
    loss, metrics = joint_loss(*heads, point, kept, consistency=consistency, reduction=reduction)
    loss.sum().backward()
    assert not loss.any() and not any(metric.any() for metric in metrics.values())
    assert weight.grad is not None and weight.grad.item() == 0


# Which head learns


@pytest.mark.parametrize("consistency", ["linear", "energy_vjp"])
@pytest.mark.parametrize(
    ("detach", "trains"), [("none", (True, True)), ("flow", (False, True)), ("denoise", (True, False))]
)
def test_consistency_trains_the_heads_that_are_not_detached(
    consistency: str, detach: str, trains: tuple[bool, bool]
) -> None:
    point = random_point(2)
    flow_weight, denoise_weight = torch.tensor(0.7).requires_grad_(), torch.tensor(-0.4).requires_grad_()
    heads = flow_weight * point.actions, denoise_weight * point.actions
    kept = torch.ones(2, 5, dtype=torch.bool)
    loss, _ = joint_loss(
        *heads, point, kept, consistency=consistency, consistency_detach=detach, **CONSISTENCY_ONLY
    )
    loss.backward()
    assert tuple(bool(weight.grad) for weight in (flow_weight, denoise_weight)) == trains


@pytest.mark.parametrize("consistency", ["linear", "energy_vjp"])
@pytest.mark.parametrize("detach", ["flow", "denoise"])
def test_a_detached_head_still_learns_its_own_target(consistency: str, detach: str) -> None:
    point = random_point(2)
    weights = torch.tensor([0.7, -0.4], requires_grad=True)
    kept = torch.ones(2, 5, dtype=torch.bool)
    heads = weights[0] * point.actions, weights[1] * point.actions
    joint_loss(*heads, point, kept, consistency=consistency, consistency_detach=detach)[0].backward()
    assert weights.grad is not None and weights.grad.all()


def test_metrics_are_detached() -> None:
    velocity, noise = VELOCITY.clone().requires_grad_(), NOISE.clone().requires_grad_()
    _, metrics = joint_loss(velocity, noise, POINT, KEPT)
    assert not any(metric.requires_grad for metric in metrics.values())


# Bad input


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"consistency": "quadratic"}, "consistency='quadratic' is unknown; choose one of: linear,"),
        ({"consistency_detach": "both"}, "consistency_detach='both' is unknown"),
        ({"use_flow_head": False}, "consistency_loss_weight=0.1 .* use_flow_head is off"),
        ({"use_denoise_head": False}, "consistency_loss_weight=0.1 .* use_denoise_head is off"),
        ({"use_flow_head": False, "use_denoise_head": False}, "at least one head"),
    ],
)
def test_objectives_that_cannot_be(changes: dict[str, Any], message: str) -> None:
    good: dict[str, Any] = {
        "consistency": "linear",
        "consistency_detach": "none",
        "consistency_loss_weight": 0.1,
        "use_flow_head": True,
        "use_denoise_head": True,
    }
    check_objective(**good)
    with pytest.raises(ValueError, match=message):
        check_objective(**good | changes)


def test_the_loss_checks_what_it_is_given() -> None:
    with pytest.raises(ValueError, match="use_denoise_head is off"):
        joint_loss(VELOCITY, None, POINT, KEPT)
    with pytest.raises(ValueError, match="reduction='sum' is unknown"):
        joint_loss(VELOCITY, NOISE, POINT, KEPT, reduction="sum")


def test_energy_needs_actions_that_are_differentiated_by() -> None:
    with pytest.raises(RuntimeError, match="does not require grad"):
        joint_loss(VELOCITY, NOISE.clone().requires_grad_(), POINT, KEPT, consistency="energy_vjp")
