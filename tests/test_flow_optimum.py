"""The optimum of the joint loss, and the energy whose gradient is the noise of a point mass."""

from itertools import product
from typing import Any

import numpy as np
import pytest
import torch
from flow_cases import CONSISTENCY_ONLY, gaussian_heads, random_point
from torch import Tensor

from lerobot_bomb.flow.losses import energy_noise, joint_loss
from lerobot_bomb.flow.path import PathPoint, path_point

KEPT = torch.ones(1, 1, dtype=torch.bool)


# Optimum


def expected_gradient(std: float, **options: Any) -> Tensor:
    """d E[loss] / d(slope and offset of both heads), where these are the conditional means; tau = 0.4.

    Expectations over z ~ N(0, 1) and A0 ~ N(1, std^2) are Gauss-Hermite sums, exact for these polynomials.
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(8)
    weights = torch.from_numpy(weights / weights.sum())
    z, clean = (
        torch.tensor(values).view(-1, 1, 1) for values in zip(*product(nodes, 1 + std * nodes), strict=True)
    )
    probability = torch.outer(weights, weights).flatten()
    tau, variance = 0.4, 0.16 * std**2 + 0.36
    noise_slope = 0.6 / variance
    clean_slope = tau * std**2 / variance
    parameters = torch.tensor(
        [clean_slope - noise_slope, 1 - tau * (clean_slope - noise_slope), noise_slope, -tau * noise_slope],
        dtype=torch.float64,
        requires_grad=True,
    )
    point = path_point(clean, z, torch.full((64,), tau, dtype=torch.float64))
    point.actions.requires_grad_()
    velocity = parameters[0] * point.actions + parameters[1]
    noise = parameters[2] * point.actions + parameters[3]
    kept = torch.ones(64, 1, dtype=torch.bool)
    losses, _ = joint_loss(velocity, noise, point, kept, reduction="none", **options)
    (gradient,) = torch.autograd.grad((losses * probability).sum(), parameters)
    return gradient


@pytest.mark.parametrize("std", [0.0, 0.5, 2.0])
@pytest.mark.parametrize("options", [{}, {"consistency_loss_weight": 10.0}, {"consistency": "none"}])
def test_conditional_means_are_the_optimum_whatever_the_consistency_weighs(
    std: float, options: dict[str, Any]
) -> None:
    assert expected_gradient(std, **options).abs().max() < 1e-12


def test_energy_vjp_leaves_the_optimum_of_a_point_mass_and_moves_that_of_spread_data() -> None:
    assert expected_gradient(0.0, consistency="energy_vjp").abs().max() < 1e-12
    assert expected_gradient(0.5, consistency="energy_vjp").abs().max() > 0.01


@pytest.mark.parametrize("tau", [0.0, 0.3, 1.0])
def test_conditional_means_agree(tau: float) -> None:
    point = random_point(4)
    point = PathPoint(point.actions.detach(), torch.full((4,), tau), point.velocity, point.noise)
    velocity, noise = (head.requires_grad_() for head in gaussian_heads(1.0, 0.5)(point.actions, point.tau))
    loss, metrics = joint_loss(velocity, noise, point, torch.ones(4, 5, dtype=torch.bool), **CONSISTENCY_ONLY)
    gradients = torch.autograd.grad(loss, (velocity, noise))
    assert metrics["consistency_residual_rms"] < 1e-6
    assert max(gradient.abs().max() for gradient in gradients) < 1e-7


# Energy


def spread_point(std: float, tau: float, action: float) -> tuple[PathPoint, Tensor, Tensor]:
    """A point with the exact heads of N(1, std^2) there."""
    actions = torch.tensor([[[action]]], requires_grad=True)
    tau_B = torch.tensor([tau])
    velocity, noise = gaussian_heads(1.0, std)(actions, tau_B)
    return PathPoint(actions, tau_B, velocity.detach(), noise.detach()), velocity, noise


def test_energy_of_spread_data_is_not_zero() -> None:
    point, velocity, noise = spread_point(0.5, 0.4, 0.3)
    assert (noise.item(), velocity.item()) == pytest.approx((-0.15, 1.125))
    (jacobian,) = torch.autograd.grad(noise, point.actions, retain_graph=True)
    assert jacobian.item() == pytest.approx(1.5)
    vjp_noise = energy_noise(noise, point, KEPT)
    assert vjp_noise.item() == pytest.approx(0.6 * -0.225)
    assert (
        vjp_noise.requires_grad and not energy_noise(noise, point, KEPT, differentiable=False).requires_grad
    )
    _, metrics = joint_loss(velocity, noise, point, KEPT, consistency="energy_vjp")
    assert metrics["consistency_loss"].item() == pytest.approx((0.4 * 1.125 - 0.3 - 0.135) ** 2, rel=1e-5)
    assert metrics["consistency_residual_rms"].item() < 1e-6  # of the linear one


@pytest.mark.parametrize("tau", [0.0, 0.2, 0.7, 0.95])
def test_energy_of_a_point_mass_is_zero(tau: float) -> None:
    point, velocity, noise = spread_point(0.0, tau, 0.3)
    torch.testing.assert_close(energy_noise(noise, point, KEPT), noise)
    _, metrics = joint_loss(velocity, noise, point, KEPT, consistency="energy_vjp")
    assert metrics["consistency_loss"].item() < 1e-11


def test_energy_takes_the_jacobian_of_the_whole_chunk_transposed() -> None:
    actions = torch.tensor([[[1.0], [3.0]]], requires_grad=True)
    matrix = torch.tensor([[1.0, 2], [0, 4]])
    point = PathPoint(actions, torch.tensor([0.5]), actions, actions)
    noise = matrix @ actions  # 7, 12
    both = torch.tensor([[True, True]])
    assert energy_noise(noise, point, both).flatten().tolist() == [0.5 * 7, 0.5 * (2 * 7 + 4 * 12)]
    first = torch.tensor([[True, False]])  # what the head says of a padded action has no energy
    assert energy_noise(noise, point, first).flatten().tolist() == [0.5 * 7, 0.5 * 2 * 7]


def test_energy_is_trained_through_its_jacobian() -> None:
    point = random_point(2, torch.float64)
    kept = torch.ones(2, 5, dtype=torch.bool)

    def loss(weight: Tensor) -> Tensor:
        heads = 0.7 * point.actions, torch.sin(weight * point.actions)
        return joint_loss(*heads, point, kept, consistency="energy_vjp", **CONSISTENCY_ONLY)[0]

    weight = torch.tensor(-0.4, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(loss(weight), weight)
    difference = (loss(weight + 1e-5) - loss(weight - 1e-5)) / 2e-5
    assert gradient.item() == pytest.approx(difference.item(), rel=1e-8)
