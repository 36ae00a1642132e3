"""Sampling of actions from noise in a few steps along the straight path, tau = 0 to 1.

What a step adds, per unit of tau, to actions A at tau, where heads predict a velocity v and a noise eps:

- ``residual``: v + alpha ((A - tau v) - eps), FDVLA's equation 2 with a sound correction: the heads'
  disagreement. Exact heads do not disagree, so every alpha gives the flow.
- ``flow``: v.
- ``ddim``: (A - eps) / tau, which is ``residual`` with alpha = 1 / tau; see `ddim_step`.
- ``sde``: v - alpha eps, and noise of variance 2 alpha (1 - tau), which keeps the flow's marginals.
- ``paper``: v + alpha eps, equation 2 to the letter, for comparison: it adds noise that v removes, so actions
  spread too widely with any number of steps.

Few steps of Euler's rule make the spread too small: from exact heads for N(1, 0.5^2) come standard deviations
of 0, 0.369, 0.431 and 0.493 with 1, 5, 10 and 100 steps.
Shapes: `B` batch, `K` action steps, `D` action dims, `N` sampling steps.
"""

from collections.abc import Callable
from itertools import pairwise
from math import sqrt

import torch
from torch import Tensor

from lerobot_bomb.flags import one_of

# velocity and noise (B, K, D); None for a missing head
type Predicted = tuple[Tensor | None, Tensor | None]
# float32 noisy actions (B, K, D) and tau (B,) -> what the heads predict
Heads = Callable[[Tensor, Tensor], Predicted]

# defaults, of the flags of policies too
SAMPLER, SOLVER = "residual", "euler"
NUM_INFERENCE_STEPS = 10
REFINE_ALPHA = 0.3
DENOISE_TAU_MIN = 0.02
CLIP_SAMPLE_RANGE = 5.0

BOTH = ("flow", "denoise")
# sampler -> the heads that it reads
SAMPLERS = {"residual": BOTH, "flow": ("flow",), "ddim": ("denoise",), "sde": BOTH, "paper": BOTH}
# solver -> the samplers that it is for
SOLVERS = {"euler": tuple(SAMPLERS), "heun": ("residual", "flow", "paper")}


def check_sampling(
    sampler: str,
    solver: str,
    num_inference_steps: int,
    refine_alpha: float,
    denoise_tau_min: float,
    clip_sample_range: float,
) -> None:
    """Raise a ValueError that names the wrong sampling flag."""
    one_of("sampler", sampler, SAMPLERS)
    one_of("solver", solver, SOLVERS)
    if sampler not in SOLVERS[solver]:
        raise ValueError(f"solver={solver} is for sampler {', '.join(SOLVERS[solver])}, not {sampler}")
    if num_inference_steps < 1:
        raise ValueError(f"num_inference_steps={num_inference_steps} must be at least 1")
    if not 0 <= refine_alpha <= 1:
        raise ValueError(f"refine_alpha={refine_alpha} must lie in [0, 1]")
    if not 0 < denoise_tau_min < 1:
        raise ValueError(f"denoise_tau_min={denoise_tau_min} must lie between 0 and 1")
    if not clip_sample_range > 0:
        raise ValueError(f"clip_sample_range={clip_sample_range} must be positive")


def num_evaluations(solver: str, num_inference_steps: int) -> int:
    """Return how often `sample` calls the heads."""
    return 2 * num_inference_steps - 1 if solver == "heun" else num_inference_steps


def check_heads(sampler: str, use_flow_head: bool, use_denoise_head: bool) -> None:
    """Raise a ValueError if the sampler reads a head that is off."""
    for head, used in zip(BOTH, (use_flow_head, use_denoise_head), strict=True):
        if head in SAMPLERS[sampler] and not used:
            raise ValueError(f"sampler={sampler} reads the {head} head, but use_{head}_head is off")


def slope(
    sampler: str, actions: Tensor, velocity: Tensor, noise: Tensor, tau: float, refine_alpha: float
) -> Tensor:
    """Return a step's change per unit of tau, for any sampler but ``ddim``; without the noise of ``sde``."""
    if sampler == "residual":
        return velocity + refine_alpha * ((actions - tau * velocity) - noise)
    if sampler == "sde":
        return velocity - refine_alpha * noise
    if sampler == "paper":
        return velocity + refine_alpha * noise
    return velocity


def ddim_step(
    actions: Tensor, noise: Tensor, tau: float, next_tau: float, clip_sample_range: float
) -> Tensor:
    """Noisy actions at ``next_tau``, between the predicted noise and the clean actions that it implies.

    The latter are clipped, because a small tau magnifies the head's errors. DDIM (Song et al. 2020, arXiv
    2010.02502) on this path in place of a variance-preserving one.
    """
    clean = (actions - (1 - tau) * noise) / tau
    return next_tau * clean.clamp(-clip_sample_range, clip_sample_range) + (1 - next_tau) * noise


def sample(
    heads: Heads,
    noise_BKD: Tensor,
    *,
    sampler: str = SAMPLER,
    solver: str = SOLVER,
    num_inference_steps: int = NUM_INFERENCE_STEPS,
    refine_alpha: float = REFINE_ALPHA,
    denoise_tau_min: float = DENOISE_TAU_MIN,
    clip_sample_range: float = CLIP_SAMPLE_RANGE,
    step_noise_BNKD: Tensor | None = None,
) -> Tensor:
    """Sample normalised actions (B, K, D) from noise of N(0, I); float32 whatever the heads compute in.

    The result depends only on the arguments: `SamplingNoise` draws all noise beforehand.

    Args:
        heads: called once a step.
        noise_BKD: where sampling starts.
        sampler: see the module.
        solver: ``euler``, or ``heun`` for an error of second order at two calls a step. Its last step is
            Euler's, as in EDM (Karras et al. 2022, arXiv 2206.00364): heads are not trained at tau = 1, and
            where actions are nearly determined, the slope there leads away from them.
        num_inference_steps: N.
        refine_alpha: in [0, 1], how much of the noise head ``residual``, ``sde`` and ``paper`` take.
        denoise_tau_min: where ``ddim`` starts, as if the noise were a point of the path; at 0 it implies
            no actions.
        clip_sample_range: bound of the clean actions that ``ddim`` infers, in normalised units.
        step_noise_BNKD: N(0, I) that ``sde`` adds, in the last step too; None for all others.

    Raises:
        ValueError: an option is out of range, the sampler reads a head that is missing, or
            ``step_noise_BNKD`` is missing, of another shape or not for this sampler.
    """
    check_sampling(sampler, solver, num_inference_steps, refine_alpha, denoise_tau_min, clip_sample_range)
    _check_step_noise(sampler, num_inference_steps, noise_BKD, step_noise_BNKD)

    def slope_at(actions_BKD: Tensor, tau: float) -> Tensor:
        return slope(sampler, actions_BKD, *_evaluate(heads, sampler, actions_BKD, tau), tau, refine_alpha)

    start = denoise_tau_min if sampler == "ddim" else 0.0
    taus = [start + (1 - start) * step / num_inference_steps for step in range(num_inference_steps + 1)]
    actions_BKD = noise_BKD.float()
    for step, (tau, next_tau) in enumerate(pairwise(taus)):
        if sampler == "ddim":
            _, eps_BKD = _evaluate(heads, sampler, actions_BKD, tau)
            actions_BKD = ddim_step(actions_BKD, eps_BKD, tau, next_tau, clip_sample_range)
            continue
        delta, slope_BKD = next_tau - tau, slope_at(actions_BKD, tau)
        if solver == "heun" and step < num_inference_steps - 1:
            slope_BKD = (slope_BKD + slope_at(actions_BKD + delta * slope_BKD, next_tau)) / 2
        actions_BKD = actions_BKD + delta * slope_BKD
        if step_noise_BNKD is not None:
            std = sqrt(2 * refine_alpha * delta * (1 - tau))
            actions_BKD = actions_BKD + std * step_noise_BNKD[:, step].float()
    return actions_BKD


def _evaluate(heads: Heads, sampler: str, actions_BKD: Tensor, tau: float) -> tuple[Tensor, Tensor]:
    """Return velocity and noise in float32; a scalar zero for a head that the sampler does not read."""
    velocity_BKD, eps_BKD = heads(actions_BKD, actions_BKD.new_full((len(actions_BKD),), tau))
    check_heads(sampler, velocity_BKD is not None, eps_BKD is not None)
    zero = torch.zeros((), device=actions_BKD.device)
    return (
        zero if velocity_BKD is None else velocity_BKD.float(),
        zero if eps_BKD is None else eps_BKD.float(),
    )


def _check_step_noise(
    sampler: str, num_steps: int, noise_BKD: Tensor, step_noise_BNKD: Tensor | None
) -> None:
    if sampler != "sde":
        if step_noise_BNKD is not None:
            raise ValueError(f"step_noise_BNKD is for sampler sde, not {sampler}")
        return
    shape = (len(noise_BKD), num_steps, *noise_BKD.shape[1:])
    found = None if step_noise_BNKD is None else tuple(step_noise_BNKD.shape)
    if found != shape:
        raise ValueError(f"sampler=sde needs step_noise_BNKD of shape {shape}, got {found}")
