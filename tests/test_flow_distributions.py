"""Samplers on noise, with heads that are known exactly.

A Gaussian's heads are affine, and so is what a sampler makes of the noise: two draws tell mean and spread.
"""

import math
from statistics import NormalDist
from typing import Any

import pytest
import torch
from flow_cases import gaussian_heads
from torch import Tensor

from lerobot_bomb.flow.noise import SamplingNoise
from lerobot_bomb.flow.samplers import sample

MEAN, STD = 1.0, 0.5
NOISE = torch.tensor([0.0, 1.0]).view(2, 1, 1)


def mean_and_std(num_steps: int, mean: float = MEAN, std: float = STD, **options: Any) -> tuple[float, float]:
    """Return mean and deviation of what the sampler makes of N(0, 1) with exact heads."""
    heads = gaussian_heads(mean, std)
    of_zero, of_one = sample(heads, NOISE, num_inference_steps=num_steps, **options).flatten().tolist()
    return of_zero, of_one - of_zero


def after_sde(num_steps: int, alpha: float, mean: float, draws_BX: Tensor) -> Tensor:
    """(B,) from draws of the first noise and of each step's."""
    return sample(
        gaussian_heads(mean, STD),
        draws_BX[:, :1, None],
        sampler="sde",
        num_inference_steps=num_steps,
        refine_alpha=alpha,
        step_noise_BNKD=draws_BX[:, 1:, None, None],
    ).flatten()


# Gaussian


@pytest.mark.parametrize("alpha", [0.0, 0.3, 1.0])
@pytest.mark.parametrize(("num_steps", "std"), [(1, 0), (5, 0.369231), (10, 0.430783), (100, 0.492645)])
def test_residual_shrinks_the_spread_by_the_steps_and_not_by_alpha(
    num_steps: int, std: float, alpha: float
) -> None:
    assert mean_and_std(num_steps, refine_alpha=alpha) == pytest.approx((1, std), abs=2e-6)
    assert mean_and_std(num_steps, sampler="flow") == pytest.approx((1, std), abs=2e-6)


@pytest.mark.parametrize(
    ("alpha", "num_steps", "std"),
    [
        (0.1, 10, 0.492825),
        (0.1, 100, 0.555338),
        (0.3, 10, 0.641302),
        (0.3, 100, 0.705335),
        (0.5, 100, 0.895274),
    ],
)
def test_the_papers_rule_spreads_too_widely(alpha: float, num_steps: int, std: float) -> None:
    found = mean_and_std(num_steps, sampler="paper", refine_alpha=alpha)
    assert found == pytest.approx((1, std), abs=2e-6)


@pytest.mark.parametrize(
    ("std", "alpha", "limit"),
    [
        (0.5, 0.1, 0.5 * math.exp(1.182836 * 0.1)),
        (1.0, 0.1, math.exp(0.1 * math.pi / 4)),
        (1.0, 0.3, math.exp(0.3 * math.pi / 4)),
    ],
)
def test_the_papers_bias_stays_with_many_steps(std: float, alpha: float, limit: float) -> None:
    found = [mean_and_std(n, std=std, sampler="paper", refine_alpha=alpha)[1] for n in (200, 400)]
    assert 2 * found[1] - found[0] == pytest.approx(limit, abs=3e-5)  # without the error of first order
    assert found[1] > 1.05 * std


@pytest.mark.parametrize(
    ("num_steps", "alpha", "std"),
    [(10, 0.5, 0.466731), (100, 0.5, 0.496096), (10, 0.0, 0.430783)],
)
def test_spread_of_the_sde(num_steps: int, alpha: float, std: float) -> None:
    units = torch.eye(num_steps + 1)  # of one draw each; the mean, 0, takes no digits of theirs
    assert after_sde(num_steps, alpha, 0.0, units).norm().item() == pytest.approx(std, abs=2e-6)
    nothing = torch.zeros(1, num_steps + 1)
    assert after_sde(num_steps, alpha, 1.0, nothing).item() == pytest.approx(1, abs=2e-6)


def test_sde_draws_noise_in_its_last_step_too() -> None:
    assert after_sde(1, 0.5, 0.0, torch.eye(2)).tolist() == [-0.5, 1.0]  # -alpha, sqrt(2 alpha)


@pytest.mark.parametrize(
    ("num_steps", "mean", "std"),
    [(1, 0.999896, 0.005206), (10, 0.991180, 0.440990), (100, 0.989943, 0.502835)],
)
def test_ddim_pays_for_starting_on_the_way(num_steps: int, mean: float, std: float) -> None:
    found = mean_and_std(num_steps, sampler="ddim", denoise_tau_min=0.02)
    assert found == pytest.approx((mean, std), abs=2e-5)  # 1 / tau makes much of float32's errors


@pytest.mark.parametrize(("num_steps", "std"), [(10, 0.490813), (100, 0.499923)])
def test_heun_keeps_the_spread(num_steps: int, std: float) -> None:
    assert mean_and_std(num_steps, solver="heun") == pytest.approx((1, std), abs=2e-6)


@pytest.mark.parametrize("sampler", ["residual", "flow"])
def test_heuns_error_is_of_second_order(sampler: str) -> None:
    errors = [STD - mean_and_std(num_steps, sampler=sampler, solver="heun")[1] for num_steps in (20, 40, 80)]
    assert abs(errors[0]) < 0.1 * (STD - mean_and_std(20, sampler=sampler)[1])
    assert [errors[0] / errors[1], errors[1] / errors[2]] == pytest.approx([4, 4], rel=0.15)


# Other data


@pytest.mark.parametrize("num_steps", [1, 3, 10])
@pytest.mark.parametrize(
    "options",
    [
        {"sampler": "residual", "refine_alpha": 0.0},
        {"sampler": "residual", "refine_alpha": 1.0},
        {"sampler": "residual", "solver": "heun"},
        {"sampler": "flow"},
        {"sampler": "flow", "solver": "heun"},
        {"sampler": "ddim"},
    ],
)
def test_a_point_mass_is_hit(options: dict[str, Any], num_steps: int) -> None:
    target = torch.linspace(-2, 2, 6).view(3, 2)
    noise = SamplingNoise(0, is_per_episode=False).draw(2, (3, 2))
    actions = sample(gaussian_heads(target, 0.0), noise, num_inference_steps=num_steps, **options)
    torch.testing.assert_close(actions, target.expand(2, 3, 2), rtol=0, atol=1e-5)


def test_the_papers_rule_misses_a_point_mass() -> None:
    _, error = mean_and_std(4, mean=0.0, std=0.0, sampler="paper", refine_alpha=0.5)
    assert error == pytest.approx(0.5 * 0.75 * (1 - 0.5 / 3) * 0.875)  # by step, 1 - (1 - alpha) / steps left


def bimodal_heads(actions_BKD: Tensor, tau_B: Tensor) -> tuple[Tensor, Tensor]:
    """Return the heads of an even mixture of N(1, 0.1^2) and N(-1, 0.1^2)."""
    tau = tau_B[:, None, None]
    share = torch.sigmoid(2 * actions_BKD * tau / (tau**2 * 0.01 + (1 - tau) ** 2))
    (v_up, eps_up), (v_down, eps_down) = (
        gaussian_heads(mean, 0.1)(actions_BKD, tau_B) for mean in (1.0, -1.0)
    )
    return share * v_up + (1 - share) * v_down, share * eps_up + (1 - share) * eps_down


@pytest.mark.parametrize(
    ("sampler", "mean", "std"),
    [("residual", 0.997, 0.0975), ("paper", 1.036, 0.179), ("flow", 0.997, 0.0975)],
)
def test_two_modes(sampler: str, mean: float, std: float) -> None:
    quantiles = [NormalDist().inv_cdf((i + 0.5) / 2000) for i in range(2000)]
    noise = torch.tensor(quantiles).view(1, -1, 1)
    actions = sample(bimodal_heads, noise, sampler=sampler, num_inference_steps=100, refine_alpha=0.3)
    up, down = actions[actions > 0], actions[actions < 0]
    assert len(up) == len(down) == 1000
    assert (up.mean().item(), down.mean().item()) == pytest.approx((mean, -mean), abs=1e-3)
    assert (up.std().item(), down.std().item()) == pytest.approx((std, std), abs=5e-4)
