"""Losses of a velocity head v and a noise head eps: a regression each, and a term for their agreement.

Conditional means satisfy eps* = A^tau - tau v* at every tau, so the agreement term is zero at the optimum of
the regressions. It replaces equations 5 to 7 of FDVLA, which equate a Jacobian with a velocity.
Shapes: `B` batch, `K` action steps, `D` action dims.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor
from torch.nn.attention import SDPBackend, sdpa_kernel

from lerobot_bomb.flags import one_of
from lerobot_bomb.flow.path import PathPoint

CONSISTENCIES = ("linear", "energy_vjp", "none")
DETACHES = ("none", "flow", "denoise")
REDUCTIONS = ("mean", "none")


def check_objective(
    consistency: str,
    consistency_detach: str,
    consistency_loss_weight: float,
    use_flow_head: bool,
    use_denoise_head: bool,
) -> None:
    """Raise a ValueError that names the flag of the loss that is wrong or lacks a head."""
    one_of("consistency", consistency, CONSISTENCIES)
    one_of("consistency_detach", consistency_detach, DETACHES)
    if not use_flow_head and not use_denoise_head:
        raise ValueError("use_flow_head and use_denoise_head are both off; at least one head is needed")
    needs_both = consistency != "none" and consistency_loss_weight > 0
    if needs_both and not (use_flow_head and use_denoise_head):
        missing = "use_denoise_head" if use_flow_head else "use_flow_head"
        raise ValueError(
            f"consistency_loss_weight={consistency_loss_weight} compares both heads, but {missing} is off; "
            "set it to 0, or consistency=none"
        )


def check_learning(
    flow_loss_weight: float,
    denoise_loss_weight: float,
    consistency_loss_weight: float,
    consistency: str,
    consistency_detach: str,
    use_flow_head: bool,
    use_denoise_head: bool,
) -> None:
    """Raise a ValueError that names a zero weight that leaves a head, or both, nothing to learn from.

    A head without a term of its own can still learn from the other one, by agreeing with it.
    """
    own = {
        head: weight
        for head, weight, used in (
            ("flow", flow_loss_weight, use_flow_head),
            ("denoise", denoise_loss_weight, use_denoise_head),
        )
        if used
    }
    agrees = consistency != "none" and consistency_loss_weight > 0
    for head, weight in own.items():
        if weight == 0 and not (agrees and consistency_detach != head and any(own.values())):
            raise ValueError(
                f"{head}_loss_weight={weight} leaves the {head} head nothing to learn from; give a positive "
                f"one, or use_{head}_head=false"
            )


def masked_mean(values_BKD: Tensor, loss_mask_BK: Tensor, reduction: str = "mean") -> Tensor:
    """Return the mean over the loss mask, (), or with ``reduction="none"`` over each row's own, (B,).

    Zero where the mask is empty.
    """
    one_of("reduction", reduction, REDUCTIONS)
    loss_mask_BKD = loss_mask_BK[..., None].expand_as(values_BKD)
    dims = (1, 2) if reduction == "none" else (0, 1, 2)
    return (values_BKD * loss_mask_BKD).sum(dims) / loss_mask_BKD.sum(dims).clamp(min=1)


def consistency_residual(velocity_BKD: Tensor, noise_BKD: Tensor, point: PathPoint) -> Tensor:
    """Return the heads' disagreement (B, K, D): eps + tau v - A^tau, tau times the difference in velocity."""
    return noise_BKD + point.tau[:, None, None] * velocity_BKD - point.actions


def energy_noise(
    noise_BKD: Tensor, point: PathPoint, loss_mask_BK: Tensor, differentiable: bool = True
) -> Tensor:
    """(1 - tau) J^T eps with J the Jacobian of eps by A^tau, (B, K, D); the noise itself if it is eps*.

    The latter holds only for a point mass of clean actions: then eps* = (A^tau - tau A0) / (1 - tau). This is
    the sound reading of FDVLA's equation 6: the gradient of an energy |eps|^2 / 2, here within the loss mask.
    ``noise_BKD`` must have been computed from ``point.actions``, which ``requires_grad``. ``differentiable``:
    whether the result can be trained through, by a second backward pass that fused attention lacks.
    """
    energy = (noise_BKD * loss_mask_BK[..., None]).square().sum() / 2
    (gradient_BKD,) = torch.autograd.grad(
        energy, point.actions, retain_graph=True, create_graph=differentiable
    )
    return (1 - point.tau[:, None, None]) * gradient_BKD


def joint_loss(
    velocity_BKD: Tensor | None,
    noise_BKD: Tensor | None,
    point: PathPoint,
    loss_mask_BK: Tensor,
    *,
    flow_loss_weight: float = 1.0,
    denoise_loss_weight: float = 1.0,
    consistency_loss_weight: float = 0.1,
    consistency: str = "linear",
    consistency_detach: str = "none",
    reduction: str = "mean",
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the weighted sum, () or (B,), of the terms that have heads, and the terms as metrics.

    Metrics are means over the batch, () and detached: ``flow_loss``, ``denoise_loss``, ``consistency_loss``,
    and as ``consistency_residual_rms`` the root mean square of `consistency_residual`, whatever
    ``consistency`` is.

    Args:
        velocity_BKD: what the flow head predicts, None without one.
        noise_BKD: what the denoising head predicts, None without one.
        point: of the straight path; its targets do not count outside the loss mask.
        loss_mask_BK: bool, the actions that the loss counts.
        flow_loss_weight: of the mean square of v - (A0 - z).
        denoise_loss_weight: of the mean square of eps - z.
        consistency_loss_weight: of the mean square of the residual.
        consistency: ``linear``: `consistency_residual`; ``energy_vjp``: the same of `energy_noise`; ``none``.
        consistency_detach: the head that the consistency does not train: ``flow``, ``denoise`` or ``none``.
        reduction: ``mean`` over the batch's loss mask, ``none`` for (B,) of each row.

    Raises:
        ValueError: an unknown choice, no head, or a consistency without both heads.
    """
    has_heads = velocity_BKD is not None, noise_BKD is not None
    check_objective(consistency, consistency_detach, consistency_loss_weight, *has_heads)
    terms, metrics = {}, {}
    if velocity_BKD is not None:
        terms["flow_loss"] = flow_loss_weight, velocity_BKD - point.velocity
    if noise_BKD is not None:
        terms["denoise_loss"] = denoise_loss_weight, noise_BKD - point.noise
    if velocity_BKD is not None and noise_BKD is not None:
        residual_BKD = consistency_residual(velocity_BKD, noise_BKD, point).detach()
        metrics["consistency_residual_rms"] = masked_mean(residual_BKD.square(), loss_mask_BK).sqrt()
        if consistency != "none" and consistency_loss_weight > 0:
            if consistency == "energy_vjp":
                noise_BKD = energy_noise(noise_BKD, point, loss_mask_BK, consistency_detach != "denoise")
            if consistency_detach == "flow":
                velocity_BKD = velocity_BKD.detach()
            elif consistency_detach == "denoise":
                noise_BKD = noise_BKD.detach()
            residual_BKD = consistency_residual(velocity_BKD, noise_BKD, point)
            terms["consistency_loss"] = consistency_loss_weight, residual_BKD
    loss = torch.zeros((), device=loss_mask_BK.device)
    for name, (weight, error_BKD) in terms.items():
        loss = loss + weight * masked_mean(error_BKD.square(), loss_mask_BK, reduction)
        metrics[name] = masked_mean(error_BKD.detach().square(), loss_mask_BK)
    return loss, metrics


@contextmanager
def second_derivatives(enabled: bool) -> Iterator[None]:
    """Use attention that, unlike its fused kernels, can be differentiated twice, if enabled."""
    if not enabled:
        yield
        return
    with torch.enable_grad(), sdpa_kernel(SDPBackend.MATH):
        yield
