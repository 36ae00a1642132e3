"""Single steps of the samplers, what heads are asked, and bad input."""

import math
from typing import Any

import pytest
import torch
from flow_cases import gaussian_heads
from torch import Tensor

from lerobot_bomb.flow.noise import SamplingNoise
from lerobot_bomb.flow.samplers import SAMPLERS, Heads, check_heads, check_sampling, ddim_step, sample, slope

NOISE = torch.tensor([0.0, 1.0]).view(2, 1, 1)
UNCLIPPED = math.inf
# one point of the path, and heads that are a little wrong there
ACTIONS, TAU = torch.tensor([0.4, 0.175]), 0.25
VELOCITY, EPS = torch.tensor([0.9, -0.7]), torch.tensor([0.1, 0.5])
TRUE_VELOCITY, TRUE_EPS = torch.tensor([0.8, -0.9]), torch.tensor([0.2, 0.4])


# One step


@pytest.mark.parametrize(
    ("sampler", "alpha", "velocity", "eps", "after"),
    [
        ("flow", 0.3, TRUE_VELOCITY, TRUE_EPS, [0.6, -0.05]),
        ("residual", 0.3, TRUE_VELOCITY, TRUE_EPS, [0.6, -0.05]),
        ("paper", 0.1, TRUE_VELOCITY, TRUE_EPS, [0.605, -0.04]),
        ("sde", 0.1, TRUE_VELOCITY, TRUE_EPS, [0.595, -0.06]),
        ("flow", 0.3, VELOCITY, EPS, [0.625, 0.0]),
        ("residual", 0.0, VELOCITY, EPS, [0.625, 0.0]),
        ("residual", 0.3, VELOCITY, EPS, [0.630625, -0.01125]),
    ],
)
def test_a_step(sampler: str, alpha: float, velocity: Tensor, eps: Tensor, after: list[float]) -> None:
    stepped = ACTIONS + 0.25 * slope(sampler, ACTIONS, velocity, eps, TAU, alpha)
    torch.testing.assert_close(stepped, torch.tensor(after))


def test_a_ddim_step() -> None:
    torch.testing.assert_close(ddim_step(ACTIONS, EPS, TAU, 0.5, UNCLIPPED), torch.tensor([0.7, -0.15]))
    torch.testing.assert_close(ddim_step(ACTIONS, EPS, TAU, 1.0, UNCLIPPED), torch.tensor([1.3, -0.8]))
    torch.testing.assert_close(ddim_step(ACTIONS, EPS, TAU, 1.0, 1.0), torch.tensor([1.0, -0.8]))
    # the noise stays as it was predicted
    torch.testing.assert_close(ddim_step(ACTIONS, EPS, TAU, 0.5, 1.0), torch.tensor([0.55, -0.15]))


@pytest.mark.parametrize("tau", [0.05, 0.25, 0.9])
def test_ddim_is_the_residual_with_alpha_one_over_tau(tau: float) -> None:
    next_tau = tau + 0.07
    stepped = ACTIONS + (next_tau - tau) * slope("residual", ACTIONS, VELOCITY, EPS, tau, 1 / tau)
    torch.testing.assert_close(ddim_step(ACTIONS, EPS, tau, next_tau, UNCLIPPED), stepped)


def test_ddim_agrees_with_the_variance_preserving_one() -> None:
    """Check a point on the same line, sqrt(abar) + sqrt(1 - abar) times as far from zero."""
    signal, next_signal = math.sqrt(0.36), math.sqrt(0.81)
    scale, next_scale = signal + math.sqrt(1 - 0.36), next_signal + math.sqrt(1 - 0.81)
    stepped = ddim_step(
        torch.tensor([0.76, 0.02]) / scale, TRUE_EPS, signal / scale, next_signal / next_scale, UNCLIPPED
    )
    torch.testing.assert_close(stepped * next_scale, torch.tensor([0.987178, -0.275644]))


@pytest.mark.parametrize(("tau", "best"), [(0.25, 0.235), (0.5, 0.4), (0.75, 0.48), (1.0, 0.5)])
def test_best_alpha_for_heads_that_err_alike(tau: float, best: float) -> None:
    def variance(alpha: float) -> float:
        """Return the slope's variance under independent errors of variance 1; the exact slope is zero."""
        zero, one = torch.tensor(0.0), torch.tensor(1.0)
        by_flow, by_denoise = (
            slope("residual", zero, *errors, tau, alpha) for errors in ((one, zero), (zero, one))
        )
        return (by_flow**2 + by_denoise**2).item()

    alphas = [i / 1000 for i in range(1001)]
    assert min(alphas, key=variance) == pytest.approx(best, abs=1e-3)


# What heads see, and what comes out


class Recorder:
    """Heads without opinion, which remember what they were asked."""

    def __init__(self):
        self.taus: list[float] = []
        self.dtypes: set[torch.dtype] = set()

    def __call__(self, actions_BKD: Tensor, tau_B: Tensor) -> tuple[Tensor, Tensor]:
        assert tau_B.shape == (len(actions_BKD),) and (tau_B == tau_B[0]).all()
        self.taus.append(tau_B[0].item())
        self.dtypes |= {actions_BKD.dtype, tau_B.dtype}
        return torch.ones_like(actions_BKD).bfloat16(), torch.zeros_like(actions_BKD).bfloat16()


@pytest.mark.parametrize(
    ("options", "taus"),
    [
        ({}, [0, 0.25, 0.5, 0.75]),
        ({"sampler": "ddim", "denoise_tau_min": 0.2}, [0.2, 0.4, 0.6, 0.8]),
        ({"solver": "heun"}, [0, 0.25, 0.25, 0.5, 0.5, 0.75, 0.75]),
    ],
)
def test_when_heads_are_asked(options: dict[str, Any], taus: list[float]) -> None:
    heads = Recorder()
    sample(heads, torch.zeros(3, 2, 1), num_inference_steps=4, **options)
    assert heads.taus == pytest.approx(taus)


def test_the_state_is_float32_between_bfloat16_heads_and_noise() -> None:
    heads = Recorder()
    actions = sample(heads, torch.zeros(1, 1, 1).bfloat16(), sampler="flow", num_inference_steps=1000)
    assert actions.dtype == torch.float32 and heads.dtypes == {torch.float32}
    assert actions.item() == pytest.approx(1, abs=1e-4)  # bfloat16 would stop at 0.25


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_a_row_does_not_depend_on_the_batch(sampler: str) -> None:
    results = []
    for batch_size in (1, 4):
        shared = SamplingNoise(5, is_per_episode=False)
        noise = shared.draw(batch_size, (3, 2))
        step_noise = shared.draw(batch_size, (10, 3, 2)) if sampler == "sde" else None
        results.append(sample(gaussian_heads(1, 0.5), noise, sampler=sampler, step_noise_BNKD=step_noise))
    assert results[1].shape == (4, 3, 2)
    for row in results[1]:
        torch.testing.assert_close(row, results[0][0])


def test_the_noise_that_is_given_is_not_written_to() -> None:
    noise = torch.ones(2, 3, 1)
    sample(gaussian_heads(1, 0.5), noise)
    assert noise.eq(1).all()


@pytest.mark.parametrize(("sampler", "head"), [("flow", 0), ("ddim", 1)])
def test_one_head_is_enough(sampler: str, head: int) -> None:
    both = gaussian_heads(1, 0.5)

    def one(actions_BKD: Tensor, tau_B: Tensor) -> tuple[Tensor | None, Tensor | None]:
        outputs = both(actions_BKD, tau_B)
        return (outputs[0], None) if head == 0 else (None, outputs[1])

    assert sample(one, NOISE, sampler=sampler).equal(sample(both, NOISE, sampler=sampler))


# Bad input


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sampler": "ddpm"}, "sampler='ddpm' is unknown; choose one of: residual, flow, ddim, sde, paper"),
        ({"solver": "rk4"}, "solver='rk4' is unknown; choose one of: euler, heun"),
        ({"solver": "heun", "sampler": "ddim"}, "solver=heun is for sampler residual, flow, paper, not ddim"),
        ({"solver": "heun", "sampler": "sde"}, "solver=heun is for .* not sde"),
        ({"num_inference_steps": 0}, "num_inference_steps=0 must be at least 1"),
        ({"refine_alpha": -0.1}, r"refine_alpha=-0.1 must lie in \[0, 1\]"),
        ({"refine_alpha": 1.1}, r"refine_alpha=1.1 must lie in \[0, 1\]"),
        ({"refine_alpha": math.nan}, "refine_alpha=nan"),
        ({"denoise_tau_min": 0.0}, "denoise_tau_min=0.0 must lie between 0 and 1"),
        ({"denoise_tau_min": 1.0}, "denoise_tau_min=1.0 must lie between 0 and 1"),
        ({"clip_sample_range": 0.0}, "clip_sample_range=0.0 must be positive"),
    ],
)
def test_options_that_cannot_be(changes: dict[str, Any], message: str) -> None:
    good: dict[str, Any] = {
        "sampler": "residual",
        "solver": "euler",
        "num_inference_steps": 1,
        "refine_alpha": 1.0,
        "denoise_tau_min": 0.02,
        "clip_sample_range": 5.0,
    }
    check_sampling(**good)
    with pytest.raises(ValueError, match=message):
        check_sampling(**good | changes)
    with pytest.raises(ValueError, match=message):
        sample(gaussian_heads(1, 0.5), NOISE, **good | changes)


@pytest.mark.parametrize(
    ("sampler", "head"),
    [
        ("residual", "flow"),
        ("residual", "denoise"),
        ("flow", "flow"),
        ("ddim", "denoise"),
        ("sde", "flow"),
        ("sde", "denoise"),
        ("paper", "flow"),
        ("paper", "denoise"),
    ],
)
def test_a_sampler_without_a_head_that_it_reads(sampler: str, head: str) -> None:
    check_heads(sampler, True, True)
    message = f"sampler={sampler} reads the {head} head, but use_{head}_head is off"
    with pytest.raises(ValueError, match=message):
        check_heads(sampler, head != "flow", head != "denoise")
    heads: Heads = (
        (lambda actions, _: (None, actions)) if head == "flow" else (lambda actions, _: (actions, None))
    )
    step_noise = torch.zeros(2, 10, 1, 1) if sampler == "sde" else None
    with pytest.raises(ValueError, match=message):
        sample(heads, NOISE, sampler=sampler, step_noise_BNKD=step_noise)


@pytest.mark.parametrize(
    ("sampler", "step_noise", "message"),
    [
        ("sde", None, r"needs step_noise_BNKD of shape \(2, 10, 1, 1\), got None"),
        ("sde", torch.zeros(2, 9, 1, 1), r"of shape \(2, 10, 1, 1\), got \(2, 9, 1, 1\)"),
        ("residual", torch.zeros(2, 10, 1, 1), "for sampler sde, not residual"),
    ],
)
def test_step_noise_is_for_the_sde(sampler: str, step_noise: Tensor | None, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        sample(gaussian_heads(1, 0.5), NOISE, sampler=sampler, step_noise_BNKD=step_noise)
