"""Ego3D position encoding: tells each image patch where in the camera's frame it lies.

SpatialVLA (Qu et al. 2025). Shapes: `B` batch, `P` patches of an image, `R` side of the lattice of points,
`E` numbers that encode a point or a patch's points, `H` hidden size of the vision model.
"""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.init import xavier_uniform_, zeros_

MIN_DEPTH_M, MAX_DEPTH_M = 0.01, 10.0  # nearer and farther points are moved here along their ray
CENTER_M, SCALE_M = (0.0, 0.0, 2.0), 2.0  # camera frame; what the encoding takes for 0, and for 1 from there
PUBLISHED_GAIN = 0.01  # of the original's initial matrices


def encode_points(points: Tensor, num_freqs: int) -> Tensor:
    """(..., 3) metres -> (..., 3 * (2 * num_freqs + 1)) in float32; NaN stays NaN.

    Each coordinate x becomes x, sin(2^k x) and cos(2^k x), k = 0, 1, ...
    """
    coordinates = (points.float() - points.new_tensor(CENTER_M, dtype=torch.float32)) / SCALE_M
    angles = coordinates[..., None] * 2.0 ** torch.arange(num_freqs, device=points.device)
    return torch.cat([coordinates[..., None], angles.sin(), angles.cos()], dim=-1).flatten(-2)


class Ego3D(nn.Module):
    """(B, R, R, 3) points of the camera's frame, metres, NaN without depth -> (B, P, H) to add to features.

    R = patches_per_side * patch_reso. Points lie at the centres of R x R cells of the image, as
    `lattice_points` gives them. Where depth is missing, a learned vector replaces a point's encoding; an
    image without depth is NaN everywhere. Without that vector (``no_depth_vector``), as in the original, a
    patch that has such a point gets zeros. With ``zero_init`` the result is exactly zero before training.
    """

    def __init__(
        self,
        hidden_size: int,
        patches_per_side: int,
        patch_reso: int = 2,
        num_freqs: int = 8,
        zero_init: bool = True,
        no_depth_vector: bool = True,
    ):
        super().__init__()
        self.patches_per_side, self.patch_reso, self.num_freqs = patches_per_side, patch_reso, num_freqs
        point_size = 3 * (2 * num_freqs + 1)
        first, last = nn.Linear(patch_reso**2 * point_size, hidden_size), nn.Linear(hidden_size, hidden_size)
        if zero_init:
            zeros_(last.weight)
            zeros_(last.bias)
        else:
            xavier_uniform_(first.weight, PUBLISHED_GAIN)
            xavier_uniform_(last.weight, PUBLISHED_GAIN)
        self.layers = nn.Sequential(first, nn.LayerNorm(hidden_size), nn.ReLU(), last)
        self.no_depth: Any = nn.Parameter(torch.zeros(point_size)) if no_depth_vector else None

    @property
    def lattice_size(self) -> int:
        """R, points on a side of the lattice."""
        return self.patches_per_side * self.patch_reso

    def forward(self, points_BRR3: Tensor) -> Tensor:
        depth_BRR1 = points_BRR3[..., 2:]
        # along the ray: the point stays in its pixel
        points_BRR3 = points_BRR3 * (depth_BRR1.clamp(MIN_DEPTH_M, MAX_DEPTH_M) / depth_BRR1)
        encoded_BRRE = encode_points(points_BRR3, self.num_freqs)
        stand_in = 0.0 if self.no_depth is None else self.no_depth.float()
        encoded_BRRE = torch.where(depth_BRR1.isnan(), stand_in, encoded_BRRE)
        positions_BPH = self.layers(self._by_patch(encoded_BRRE).to(next(self.parameters()).dtype))
        if self.no_depth is not None:
            return positions_BPH
        lacks_depth_BP1 = self._by_patch(depth_BRR1).isnan().any(dim=-1, keepdim=True)
        return positions_BPH.masked_fill(lacks_depth_BP1, 0.0)

    def _by_patch(self, values_BRRE: Tensor) -> Tensor:
        """(B, R, R, E) of points -> (B, P, E of all points of a patch)."""
        side = self.patches_per_side
        values_BSrScE = values_BRRE.unflatten(2, (side, -1)).unflatten(1, (side, -1))
        return values_BSrScE.transpose(2, 3).flatten(3).flatten(1, 2)
