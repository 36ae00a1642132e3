"""Samplers of ``fdvla`` on noise, where the heads are exact.

For a number that is N(1, 0.5^2), and for one that is N(1, 0.1^2) or N(-1, 0.1^2), conditional means are
known in closed form; what is wrong is then the sampler's. Its options are the policy's defaults.

    python benchmarks/flow_samplers.py --json flow_samplers.json

Shapes: `B` samples, each a chunk of K = 1 action with D = 1 dim, `N` sampling steps, `M` modes.
"""

import argparse
from statistics import NormalDist
from typing import Any

import torch
from machine import writable, write_figures
from torch import Tensor

from lerobot_bomb.flow.samplers import Heads, sample
from lerobot_bomb.tables import print_table

NUM_STEPS = (1, 5, 10, 100)
SETTINGS: dict[str, dict[str, Any]] = {
    "residual": {"sampler": "residual"},
    "residual, heun": {"sampler": "residual", "solver": "heun"},
    "flow": {"sampler": "flow"},
    "ddim": {"sampler": "ddim"},
    "sde": {"sampler": "sde"},
    "paper": {"sampler": "paper"},
}
NUM_SAMPLES = 20_000  # of two modes


def main() -> None:
    """Print a table for each distribution."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--json", type=writable, help="also write the figures to this file")
    args = parser.parse_args()
    one_mode = {name: [of_one_mode(options, n) for n in NUM_STEPS] for name, options in SETTINGS.items()}
    two_modes = {name: [of_two_modes(options, n) for n in NUM_STEPS] for name, options in SETTINGS.items()}
    columns = [f"{n} steps" for n in NUM_STEPS]
    print("N(1, 0.5^2): mean and standard deviation")
    print_table(["", *columns], [[name, *map(_text, cells)] for name, cells in one_mode.items()])
    print("\nN(1, 0.1^2) or N(-1, 0.1^2): share above 0; mean and standard deviation of the distance from 0")
    print_table(["", *columns], [[name, *map(_text, cells)] for name, cells in two_modes.items()])
    write_figures(args.json, {"num_steps": NUM_STEPS, "one_mode": one_mode, "two_modes": two_modes})


def mixture_heads(means_M: Tensor, std: float) -> Heads:
    """Conditional means of A0 - z and of z, given A^tau, for A0 ~ N(mean, std^2) with any of the means."""

    def heads(actions_BKD: Tensor, tau_B: Tensor) -> tuple[Tensor, Tensor]:
        tau = tau_B[:, None, None, None]
        variance = tau**2 * std**2 + (1 - tau) ** 2
        distance_BKDM = actions_BKD[..., None] - tau * means_M
        share_BKDM = (-(distance_BKDM**2) / (2 * variance)).softmax(dim=-1)
        noise_BKDM = (1 - tau) * distance_BKDM / variance
        clean_BKDM = means_M + tau * std**2 * distance_BKDM / variance
        noise_BKD, clean_BKD = ((share_BKDM * of).sum(dim=-1) for of in (noise_BKDM, clean_BKDM))
        return clean_BKD - noise_BKD, noise_BKD

    return heads


def of_one_mode(options: dict[str, Any], num_steps: int) -> tuple[float, float]:
    """Exact mean and standard deviation of the samples: they are an affine function of all noise drawn."""
    draws_BX = torch.cat(
        [torch.zeros(1, num_steps + 1), torch.eye(num_steps + 1)]
    )  # none, then one unit each
    samples_B = _sample(mixture_heads(torch.tensor([1.0]), 0.5), draws_BX, options)
    return samples_B[0].item(), (samples_B[1:] - samples_B[0]).norm().item()


def of_two_modes(options: dict[str, Any], num_steps: int) -> tuple[float, float, float]:
    """Share of the samples above 0, and mean and standard deviation of their distance from 0."""
    quantiles_B = [NormalDist().inv_cdf((i + 0.5) / NUM_SAMPLES) for i in range(NUM_SAMPLES)]
    step_noise_BN = torch.randn(NUM_SAMPLES, num_steps, generator=torch.Generator().manual_seed(0))
    draws_BX = torch.cat([torch.tensor(quantiles_B)[:, None], step_noise_BN], dim=1)
    samples_B = _sample(mixture_heads(torch.tensor([-1.0, 1.0]), 0.1), draws_BX, options)
    distance_B = samples_B.abs()
    return (samples_B > 0).float().mean().item(), distance_B.mean().item(), distance_B.std().item()


def _sample(heads: Heads, draws_BX: Tensor, options: dict[str, Any]) -> Tensor:
    """(B,) from X = 1 + N draws: the first noise, and what ``sde`` adds in each step."""
    draws_BX11 = draws_BX[..., None, None]
    step_noise_BNKD = draws_BX11[:, 1:] if options["sampler"] == "sde" else None
    num_steps = draws_BX.shape[1] - 1
    samples_BKD = sample(
        heads,
        draws_BX11[:, 0],
        num_inference_steps=num_steps,
        step_noise_BNKD=step_noise_BNKD,
        **options,
    )
    return samples_BKD[:, 0, 0]


def _text(numbers: tuple[float, ...]) -> str:
    *shares, mean, std = numbers
    return " ".join([*(f"{share:.1%}" for share in shares), f"{mean:.3f} {std:.3f}"])


if __name__ == "__main__":
    main()
