"""Muon, an optimizer for the matrices of hidden layers, beside AdamW for all other parameters.

Keller Jordan et al., "Muon: an optimizer for hidden layers in neural networks" (2024), with steps of AdamW's
size as in Liu et al., arXiv 2502.16982. `torch.optim.Muon` takes nothing but matrices, and LeRobot trains by
one optimizer.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import torch
from lerobot.optim import AdamWConfig, OptimizerConfig
from torch import Tensor, nn
from torch.distributed.tensor import DTensor
from torch.optim.adamw import adamw

# of Newton and Schulz's iteration as Jordan chose them: five bring all singular values near 1
QUINTIC = 3.4445, -4.7750, 2.0315
NUM_ITERATIONS = 5
# root mean square of a step, in learning rates; twice that of Liu et al., chosen in a short trial
STEP_RMS = 0.4
LEAST_SIDE = 32  # narrower matrices map to or from actions and states, not between hidden layers
HEAD = "head"  # ends the names of layers that score a vocabulary
IS_MATRIX = "is_matrix"


@OptimizerConfig.register_subclass("muon_adamw")
@dataclass
class MuonConfig(AdamWConfig):
    """Settings of AdamW, and Muon's momentum; both have the same learning rate and weight decay."""

    momentum: float = 0.95

    def build(self, params: Any) -> "Muon":
        """Build the optimizer of `parameter_groups`, or of parameters, of which all matrices are Muon's."""
        groups = list(params)
        if not isinstance(groups[0], dict):
            groups = _grouped((parameter, parameter.ndim == 2) for parameter in groups)
        return Muon(groups, self)


def parameter_groups(model: nn.Module) -> list[dict[str, Any]]:
    """Split a model's trained parameters into weights between hidden layers and all others."""
    matrices = {
        layer.weight
        for name, layer in model.named_modules()
        if isinstance(layer, nn.Linear) and not name.endswith(HEAD) and min(layer.weight.shape) >= LEAST_SIDE
    }
    matrices -= {layer.weight for layer in model.modules() if isinstance(layer, nn.Embedding)}
    trained = (parameter for parameter in model.parameters() if parameter.requires_grad)
    return _grouped((parameter, parameter in matrices) for parameter in trained)


def _grouped(parameters: Iterable[tuple[nn.Parameter, bool]]) -> list[dict[str, Any]]:
    groups = {True: [], False: []}
    for parameter, is_matrix in parameters:
        groups[is_matrix].append(parameter)
    return [{"params": members, IS_MATRIX: is_matrix} for is_matrix, members in groups.items() if members]


class Muon(torch.optim.Optimizer):
    """Steps by orthogonalised momentum for groups of matrices, and AdamW's for the others."""

    def __init__(self, groups: list[dict[str, Any]], config: MuonConfig):
        names = "lr", "betas", "eps", "weight_decay", "momentum"
        super().__init__(groups, {name: getattr(config, name) for name in names})

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            parameters = [parameter for parameter in group["params"] if parameter.grad is not None]
            (self._step_matrices if group[IS_MATRIX] else self._step_others)(parameters, group)
        return loss

    def _step_matrices(self, parameters: list[Tensor], group: dict[str, Any]) -> None:
        same_shape: dict[torch.Size, list[Tensor]] = defaultdict(list)
        for parameter in parameters:
            same_shape[parameter.shape].append(parameter)
        for shape, matrices in same_shape.items():
            steps = orthogonal(
                torch.stack([self._momentum(matrix, group["momentum"]) for matrix in matrices])
            )
            # an orthogonal matrix has a root mean square of 1 / sqrt(its longer side)
            size = group["lr"] * STEP_RMS * max(shape) ** 0.5
            for matrix, step in zip(matrices, steps, strict=True):
                matrix.mul_(1 - group["lr"] * group["weight_decay"]).add_(step.to(matrix.dtype), alpha=-size)

    def _momentum(self, matrix: Tensor, momentum: float) -> Tensor:
        """Return Nesterov's mean of a matrix's gradients."""
        if matrix.ndim != 2 or isinstance(matrix, DTensor):
            raise RuntimeError(
                "--policy.optimizer=muon needs whole matrices, which FSDP splits; give "
                "--policy.optimizer=adamw"
            )
        assert matrix.grad is not None
        state = self.state[matrix]
        if not state:
            state["momentum"] = torch.zeros_like(matrix)
        mean = state["momentum"].lerp_(matrix.grad, 1 - momentum)
        return matrix.grad.lerp(mean, momentum)

    def _step_others(self, parameters: list[Tensor], group: dict[str, Any]) -> None:
        for parameter in parameters:
            if not self.state[parameter]:
                moments = {name: torch.zeros_like(parameter) for name in ("exp_avg", "exp_avg_sq")}
                self.state[parameter] |= {**moments, "step": torch.zeros(())}
        states = [self.state[parameter] for parameter in parameters]
        beta1, beta2 = group["betas"]
        adamw(
            parameters,  # pyright: ignore[reportArgumentType]
            [parameter.grad for parameter in parameters],  # pyright: ignore[reportArgumentType]
            [state["exp_avg"] for state in states],
            [state["exp_avg_sq"] for state in states],
            [],
            [state["step"] for state in states],
            amsgrad=False,
            beta1=beta1,
            beta2=beta2,
            lr=group["lr"],
            weight_decay=group["weight_decay"],
            eps=group["eps"],
            maximize=False,
        )


def orthogonal(matrices: Tensor) -> Tensor:
    """(N, rows, columns) -> about the nearest matrices with orthonormal rows, or columns if these are fewer.

    Their singular values lie between 0.7 and 1.2, except those that were nearly 0.
    """
    is_tall = matrices.shape[-2] > matrices.shape[-1]
    x = matrices.float()
    x = x.mT if is_tall else x
    x = x / (x.norm(dim=(-2, -1), keepdim=True) + 1e-7)
    a, b, c = QUINTIC
    for _ in range(NUM_ITERATIONS):
        gram = x @ x.mT
        x = a * x + (b * gram + c * gram @ gram) @ x
    return x.mT if is_tall else x
