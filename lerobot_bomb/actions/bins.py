"""Continuous values in [-1, 1] <-> bin indices."""

import torch
from torch import Tensor, nn

from lerobot_bomb.finite import require_finite_on_cpu

BIN_MODES = ("centers", "levels")

# Widens the outermost bins so that values within float32 rounding of the ends stay inside.
EDGE_MARGIN = 1e-6


class Bins(nn.Module):
    """Uniform quantiser of [-1, 1].

    ``centers``: ``num_bins`` right-closed intervals, decoded to their centres; error <= 1/num_bins;
    neither -1, 1 nor (for an even number) 0 can be written.
    ``levels``: ``num_bins`` points from -1 to 1, both included; error <= 1/(num_bins - 1); 0 can be
    written when the number is odd.
    """

    edges: Tensor

    def __init__(self, num_bins: int, mode: str):
        super().__init__()
        self.num_bins = num_bins
        self.mode = mode
        end = 1 + EDGE_MARGIN
        self.register_buffer("edges", torch.linspace(-end, end, num_bins + 1), persistent=False)

    def encode(self, values: Tensor) -> Tensor:
        """Values of any shape -> int64 indices in 0..num_bins - 1; values beyond [-1, 1] saturate.

        Raises:
            ValueError: values on the CPU are not finite. On CUDA they are not checked: the host would wait.
        """
        require_finite_on_cpu(values, "what is written as a number")
        values = values.float().clamp(-1, 1)
        if self.mode == "levels":
            return ((values + 1) / 2 * (self.num_bins - 1) + 0.5).floor().long()
        return (torch.bucketize(values, self.edges) - 1).clamp(0, self.num_bins - 1)

    def decode(self, indices: Tensor) -> Tensor:
        """Indices of any shape -> float32 values in [-1, 1]."""
        if self.mode == "levels":
            return 2 * indices.float() / (self.num_bins - 1) - 1
        return (2 * indices.float() + 1) / self.num_bins - 1
