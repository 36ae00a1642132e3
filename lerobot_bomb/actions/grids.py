"""Continuous actions <-> cells of a grid that follows the data's distribution: SpatialVLA's action tokens.

Shapes: `N` samples, `D` action dims, `G` groups, `C` coordinates of all groups, `E` bins of the finest one,
`V` cells of all groups, `P` dims of the widest group.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import accumulate, pairwise
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor, nn

from lerobot_bomb.actions.grid_edges import Cut, from_polar, gaussian_cut, to_polar, unrolled
from lerobot_bomb.actions.grid_fit import check_actions, fit_cuts
from lerobot_bomb.actions.grid_settings import ActionGroup, GridSettings, check_groups, default_groups
from lerobot_bomb.finite import require_finite, require_finite_on_cpu

PUBLISHED_KEYS = ("theta", "phi", "r", "roll", "pitch", "yaw")


class ActionGrids(nn.Module):
    """Actions in [-1, 1] (..., D) <-> a cell per group (..., G).

    Polar coordinates are taken around `rest`, the normalised action that means "no motion". Until `fit`, bins
    are of about equal width around 0. Buffers stay float32 whatever type the module is cast to. They are in
    no `state_dict`; a checkpoint's config holds them, as `to_dict` returns them.
    """

    edges: Tensor  # (C, E + 1) of the bins, increasing; rows of fewer bins end with inf
    gaussians: Tensor  # (C, 2) mean and standard deviation of the samples
    means: Tensor  # (C, E) mean value in each bin
    centroids: Tensor  # (V, P) mean action of the samples in each cell; from `means` where there are none
    rest: Tensor  # (D,)
    _dims: Tensor  # (D,) int64, the groups' dims one after the other
    _order: Tensor  # (D,) int64, position of each dim in `_dims`
    _last_bin: Tensor  # (C, 1) int64

    def __init__(self, settings: GridSettings, num_dims: int):
        super().__init__()
        check_groups(settings.groups, num_dims)
        self.settings = settings
        self.groups = settings.groups
        self.decode_point = settings.decode_point
        self.num_dims = num_dims
        self.num_cells = [group.num_cells for group in self.groups]
        *self.offsets, self.num_tokens = accumulate(self.num_cells, initial=0)
        self.bins = [bins for group in self.groups for bins in group.bins]
        # slice of each group among the coordinates, and among the groups' dims
        self._rows = _slices(len(group.bins) for group in self.groups)
        self._columns = _slices(len(group.dims) for group in self.groups)
        num_coordinates, finest = len(self.bins), max(self.bins)
        widest = max(len(group.dims) for group in self.groups)
        dims = torch.tensor([dim for group in self.groups for dim in group.dims])
        for name, values in {
            "edges": torch.full((num_coordinates, finest + 1), math.inf),
            "gaussians": torch.zeros(num_coordinates, 2),
            "means": torch.zeros(num_coordinates, finest),
            "centroids": torch.zeros(self.num_tokens, widest),
            "rest": torch.zeros(num_dims),
            "_dims": dims,
            "_order": dims.argsort(),
            "_last_bin": torch.tensor(self.bins)[:, None] - 1,
        }.items():
            self.register_buffer(name, values, persistent=False)
        rest_D = np.zeros(num_dims)
        self._set(fit_cuts(torch.zeros(0, num_dims, dtype=torch.float64), rest_D, settings), rest_D)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Move buffers to another device, but not to another type: in bfloat16 edges would coincide."""
        return super()._apply(lambda tensor: tensor.to(fn(tensor[:0]).device), recurse)

    # Actions and cells

    def encode(self, actions: Tensor) -> Tensor:
        """Actions (..., D) -> cells (..., G) int64, counted in each group; actions are clipped to [-1, 1].

        Raises:
            ValueError: the number of dims is wrong or, on the CPU, an action is not finite. On CUDA this is
                not checked: the host would wait.
        """
        require_finite_on_cpu(actions, "an action that is put into a grid")
        self._check_dims(actions.shape[-1])
        values_CN = self.coordinates(actions.to(self.edges.dtype).clamp(-1, 1)).reshape(-1, len(self.bins)).T
        # bins are closed on the left: a bin's index is the number of edges up to the value, less the first
        bins_CN = torch.searchsorted(self.edges[:, 1:].contiguous(), values_CN.contiguous(), right=True)
        bins_CN = torch.minimum(bins_CN, self._last_bin)
        cells = [self._cell(i, bins_CN[rows]) for i, rows in enumerate(self._rows)]
        return torch.stack(cells, dim=-1).view(*actions.shape[:-1], len(self.groups))

    def decode(self, cells: Tensor, point: str | None = None) -> Tensor:
        """Cells (..., G) -> (..., D) float32 in [-1, 1]; ``point`` replaces the grid's decode point."""
        parts = [self.decode_group(i, cells[..., i], point) for i in range(len(self.groups))]
        return torch.cat(parts, dim=-1)[..., self._order]

    def decode_group(self, index: int, cells: Tensor, point: str | None = None) -> Tensor:
        """Cells (...) of one group -> its dims (..., P of the group), float32 in [-1, 1].

        ``point`` replaces the grid's decode point.
        """
        point = point or self.decode_point
        group, rows = self.groups[index], self._rows[index]
        if group.transform == "binary":
            return 2 * cells[..., None].to(self.edges.dtype) - 1
        bins = torch.unravel_index(cells, group.bins)
        rest = self.rest[self._dims][self._columns[index]]
        if point == "centroid":
            values = self.centroids[self.offsets[index] + cells, : len(rest)]
        else:
            points = self._midpoints() if point == "mid" else self.means
            values = torch.stack(
                [row[indices] for row, indices in zip(points[rows], bins, strict=True)], dim=-1
            )
            if group.transform == "polar":
                values = rest + from_polar(values)
        if self._has_zero_bin(group):
            values = torch.where(bins[-1][..., None] == 0, rest, values)
        return values.clamp(-1, 1)

    def coordinates(self, actions: Tensor) -> Tensor:
        """Actions (..., D) -> coordinates (..., C), phi within its edges; polar angles in radians."""
        actions, rest, parts = actions[..., self._dims], self.rest[self._dims], []
        for group, rows, columns in zip(self.groups, self._rows, self._columns, strict=True):
            values = actions[..., columns]
            if group.transform == "polar":
                theta, phi, rho = to_polar(values - rest[columns]).unbind(dim=-1)
                edges_of_phi = self.edges[rows.start + 1]
                phi = unrolled(phi, edges_of_phi[0], edges_of_phi[group.bins[1]])
                values = torch.stack([theta, phi, rho], dim=-1)
            parts.append(values)
        return torch.cat(parts, dim=-1)

    def _cell(self, index: int, bins: Tensor) -> Tensor:
        """Bins (coordinates of the group, N) -> cells (N,)."""
        group = self.groups[index]
        cells = torch.zeros_like(bins[0])
        for indices, num_bins in zip(bins, group.bins, strict=True):
            cells = cells * num_bins + indices
        return torch.where(bins[-1] == 0, 0, cells) if self._has_zero_bin(group) else cells

    def _has_zero_bin(self, group: ActionGroup) -> bool:
        return self.settings.zero_radius_bin and group.transform == "polar"

    def _midpoints(self) -> Tensor:
        """(C, E) middles of the bins; rows of fewer bins end with inf."""
        return (self.edges[:, :-1] + self.edges[:, 1:]) / 2

    def _check_dims(self, num_dims: int) -> None:
        if num_dims != self.num_dims:
            raise ValueError(f"the action has {num_dims} dims, but the grid was made for {self.num_dims}")

    # Fitted values

    @torch.no_grad()
    def fit(self, actions_ND: np.ndarray | Tensor, rest_D: np.ndarray | None = None) -> None:
        """Fit the cells to normalised actions, clipped to [-1, 1].

        ``rest_D``: the normalised action that means "no motion", clipped to [-1, 1]; zeros if not given.

        Raises:
            ValueError: there are no actions, their size is wrong, or some are not finite.
        """
        actions_ND = check_actions(actions_ND)
        self._check_dims(actions_ND.shape[1])
        actions_ND = actions_ND.clamp(-1, 1)
        rest_D = np.zeros(self.num_dims) if rest_D is None else np.clip(rest_D, -1, 1)
        self._set(fit_cuts(actions_ND, rest_D, self.settings), rest_D)
        self._set_centroids(actions_ND)

    @classmethod
    def from_published(
        cls,
        parameters: dict[str, dict[str, float]],
        min_sigma: float = 0.0,
        decode_point: str = "cond_mean",
        groups: tuple[ActionGroup, ...] | None = None,
    ) -> Self:
        """Build the grid of SpatialVLA's gs_*.json, for 7 action dims; the original decodes to "mid".

        Its gripper is 0 closed and 1 open; here these are -1 and 1.
        """
        if missing := [key for key in PUBLISHED_KEYS if key not in parameters]:
            raise ValueError(f"the published grid lacks {', '.join(missing)}; it has {', '.join(parameters)}")
        groups = default_groups(7, layout="pose") if groups is None else groups
        settings = GridSettings(groups, "gaussian", min_sigma, decode_point, False, phi_fit="linear")
        grids = cls(settings, 7)
        lows, highs = [0, -math.pi, 0, -1, -1, -1], [math.pi, math.pi, math.sqrt(3), 1, 1, 1]
        cuts = [
            gaussian_cut(gaussian["mu"], max(gaussian["sigma"], min_sigma), low, high, num_bins)
            for gaussian, low, high, num_bins in zip(
                (parameters[key] for key in PUBLISHED_KEYS), lows, highs, grids.bins, strict=False
            )
        ]
        grids._set([*cuts, gaussian_cut(0.0, 1.0, -1, 1, 2)], np.zeros(7))
        return grids

    @classmethod
    def from_edges(cls, edges: Sequence[Tensor], settings: GridSettings, num_dims: int) -> Self:
        """Build a grid from nothing but edges, (E + 1,) for each coordinate: means are the bins' middles."""
        cuts = []
        for row in edges:
            low, high = float(row[0]), float(row[-1])
            cuts.append(Cut(row.double(), (row[:-1] + row[1:]).double() / 2, (low + high) / 2, high - low))
        grids = cls(settings, num_dims)
        grids._set(cuts, np.zeros(num_dims))
        return grids

    def group_edges(self, index: int) -> list[Tensor]:
        """(bins + 1,) float64 on the CPU for each coordinate of one group."""
        rows = self._rows[index]
        edges = self.edges[rows].double().cpu()
        return [row[: bins + 1] for row, bins in zip(edges, self.bins[rows], strict=True)]

    def to_dict(self) -> dict[str, Any]:
        """Return the grid as JSON values, bit for bit; the many centroids only if it decodes to them."""
        fitted = {
            "edges": [row[: bins + 1].tolist() for row, bins in zip(self.edges, self.bins, strict=True)],
            "means": [row[:bins].tolist() for row, bins in zip(self.means, self.bins, strict=True)],
            "gaussians": self.gaussians.tolist(),
            "rest": self.rest.tolist(),
        }
        if self.decode_point == "centroid":
            others = (self.centroids != self._cond_means()).any(dim=1).nonzero()[:, 0].tolist()
            fitted["centroids"] = {str(cell): self.centroids[cell].tolist() for cell in others}
        return {"settings": replace(self.settings, decode_point=self.decode_point).to_dict(), **fitted}

    @classmethod
    def from_dict(cls, parameters: dict[str, Any], num_dims: int) -> Self:
        """Build the grid that `to_dict` returned, for actions of ``num_dims`` dims."""
        grids = cls(GridSettings.from_dict(parameters["settings"]), num_dims)
        rows = (parameters[key] for key in ("edges", "means", "gaussians"))
        cuts = [
            Cut(torch.tensor(edges, dtype=torch.float64), torch.tensor(means), mean, std)
            for edges, means, (mean, std) in zip(*rows, strict=True)
        ]
        grids._set(cuts, np.array(parameters["rest"]))
        if grids.decode_point == "centroid":
            for cell, values in parameters["centroids"].items():
                grids.centroids[int(cell)] = torch.tensor(values)
            require_finite(grids.centroids, "a grid's centroids")
        return grids

    def _set(self, cuts: Sequence[Cut], rest_D: np.ndarray) -> None:
        """Set the edges, as they are in float32, and what follows from them."""
        require_finite(torch.as_tensor(rest_D), "the action of a grid that means no motion")
        self.rest.copy_(torch.from_numpy(rest_D))
        for i, (cut, bins) in enumerate(zip(cuts, self.bins, strict=True)):
            if cut.edges.shape != (bins + 1,) or not (cut.edges.diff() > 0).all():
                raise ValueError(
                    f"coordinate {i} of the grid needs {bins + 1} increasing edges: {cut.edges.tolist()}"
                )
            fitted = torch.cat([cut.edges, cut.means, torch.tensor([cut.mean, cut.std])])
            require_finite(fitted, f"coordinate {i} of the grid (edges, means, mean, standard deviation)")
            self.edges[i, : bins + 1] = cut.edges
            self.means[i, :bins] = cut.means
            self.gaussians[i] = torch.tensor([cut.mean, cut.std])
        self._set_centroids(torch.zeros(0, self.num_dims, dtype=torch.float64))

    def _set_centroids(self, actions_ND: Tensor) -> None:
        """Set each cell's centroid to the mean of its samples; without samples, to its point of `means`."""
        self.centroids.copy_(self._cond_means())
        cells_NG = self.encode(actions_ND.to(self.edges.device)).cpu()
        for i, group in enumerate(self.groups):
            cells_N, values_NP = cells_NG[:, i], actions_ND[:, list(group.dims)]
            counts = torch.bincount(cells_N, minlength=group.num_cells)
            sums = values_NP.new_zeros(group.num_cells, len(group.dims)).index_add_(0, cells_N, values_NP)
            found = counts.nonzero()[:, 0]
            rows = (self.offsets[i] + found).to(self.edges.device)
            means = (sums[found] / counts[found, None]).to(self.centroids)
            self.centroids[rows, : len(group.dims)] = means

    def _cond_means(self) -> Tensor:
        """(V, P) float32: the action of each cell at the means of its bins."""
        means = torch.zeros_like(self.centroids)
        for i, (first, num_cells) in enumerate(zip(self.offsets, self.num_cells, strict=True)):
            cells = torch.arange(num_cells, device=means.device)
            values = self.decode_group(i, cells, "cond_mean")
            means[first : first + num_cells, : values.shape[1]] = values
        return means


def _slices(lengths: Iterable[int]) -> list[slice]:
    """Return the slices of parts that lie one after the other."""
    return [slice(*ends) for ends in pairwise(accumulate(lengths, initial=0))]
