"""How a grid is made: which action dims share a token, in which coordinates, cut where."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from lerobot_bomb.flags import one_of

DISTRIBUTIONS = ("gaussian", "uniform", "quantile")
DECODE_POINTS = ("mid", "cond_mean", "centroid")
PHI_FITS = ("wrapped", "linear")
TRANSFORMS = ("polar", "identity", "binary")
POLAR_COORDINATES = ("theta", "phi", "rho")
POLAR_BINS = (16, 32, 8)
LINEAR_BINS = 16
MAX_BINS = 4096  # of a coordinate
FLAG = "--policy.action_groups"
# flags of the policy that are called otherwise than the field of `GridSettings`
FLAG_NAMES = {"groups": "action_groups", "distribution": "grid_distribution", "min_sigma": "grid_min_sigma"}


@dataclass(frozen=True)
class ActionGroup:
    """Action dims that are one token. A cell's index is row-major over `bins`: the first is slowest."""

    # which dims of the action
    dims: tuple[int, ...]
    # polar: x, y, z -> theta from z and phi from x in radians, rho; identity: as they are; binary: closed
    # below 0, open from 0 on, decoded to -1 and 1
    transform: str
    # cells along each coordinate
    bins: tuple[int, ...]

    def __post_init__(self) -> None:
        one_of(f"{FLAG}: transform", self.transform, TRANSFORMS)
        num_dims = {"polar": 3, "binary": 1}.get(self.transform, len(self.dims))
        if not self.dims or len(self.dims) != num_dims or len(self.bins) != num_dims:
            raise ValueError(
                f"{FLAG}: a group {self.transform} of the dims {list(self.dims)} has bins {list(self.bins)}; "
                f"polar has 3 of each, binary 1, identity as many bins as dims"
            )
        if self.transform == "binary" and self.bins != (2,):
            raise ValueError(f"{FLAG}: a binary group has bins [2], not {list(self.bins)}")
        if not all(2 <= bins <= MAX_BINS for bins in self.bins):
            raise ValueError(f"{FLAG}: bins {list(self.bins)} must each be in 2..{MAX_BINS}")

    @classmethod
    def from_dict(cls, group: dict[str, Any]) -> "ActionGroup":
        """Of JSON."""
        keys = {"dims", "transform", "bins"}
        if set(group) != keys:
            raise ValueError(f"{FLAG}: {group} must have exactly the keys {sorted(keys)}")
        return cls(tuple(group["dims"]), group["transform"], tuple(group["bins"]))

    @property
    def num_cells(self) -> int:
        return math.prod(self.bins)

    def coordinate_names(self, dim_names: Sequence[str]) -> list[str]:
        """Of the coordinates, given the names of all action dims."""
        return [*POLAR_COORDINATES] if self.transform == "polar" else [dim_names[dim] for dim in self.dims]


def default_groups(num_dims: int) -> tuple[ActionGroup, ...]:
    """Groups for actions of 7 dims (pose, gripper), 4 (position, gripper), 14 (two arms) or any other."""
    if num_dims == 7:
        gripper = ActionGroup((6,), "binary", (2,))
        return (ActionGroup((0, 1, 2), "polar", POLAR_BINS), _linear(3, 4, 5), gripper)
    if num_dims == 4:
        return (ActionGroup((0, 1, 2), "polar", POLAR_BINS), _linear(3))
    if num_dims == 2:
        return (ActionGroup((0, 1), "identity", (64, 64)),)
    arms = (range(7), range(7, 14)) if num_dims == 14 else (range(num_dims),)
    return tuple(_linear(*arm[first : first + 3]) for arm in arms for first in range(0, len(arm), 3))


def _linear(*dims: int) -> ActionGroup:
    return ActionGroup(dims, "identity", (LINEAR_BINS,) * len(dims))


def check_groups(groups: Sequence[ActionGroup], num_dims: int) -> None:
    """Raise a ValueError unless every one of an action's dims is in exactly one group."""
    dims = sorted(dim for group in groups for dim in group.dims)
    if dims != list(range(num_dims)):
        raise ValueError(
            f"{FLAG}: the groups have the dims {dims}; the action has {num_dims}, and each of "
            f"{list(range(num_dims))} must be in exactly one group"
        )


@dataclass(frozen=True)
class GridSettings:
    """How a grid is made; what it became in a fit is in `ActionGrids`."""

    groups: tuple[ActionGroup, ...]
    # of the edges: equal shares of a Gaussian, equal widths, equal shares of the samples
    distribution: str = "gaussian"
    # least standard deviation of a coordinate's Gaussian
    min_sigma: float = 0.0
    # what a cell is decoded to: its middle; the means of its bins; the mean of the samples in it
    decode_point: str = "cond_mean"
    # whether the polar groups' first bin of rho means "no motion" exactly
    zero_radius_bin: bool = True
    # rho, in normalised units, below which that is so
    rho_dead: float = 0.02
    # whether phi is cut opposite the samples' mean direction, or at pi
    phi_fit: str = "wrapped"

    def __post_init__(self) -> None:
        one_of("--policy.grid_distribution", self.distribution, DISTRIBUTIONS)
        one_of("--policy.decode_point", self.decode_point, DECODE_POINTS)
        one_of("--policy.phi_fit", self.phi_fit, PHI_FITS)
        if not 0 <= self.min_sigma < math.inf:
            raise ValueError(f"--policy.grid_min_sigma={self.min_sigma} must be a number of at least 0")
        if not 1e-3 <= self.rho_dead <= 0.5:
            raise ValueError(f"--policy.rho_dead={self.rho_dead} must be in [0.001, 0.5]")

    @classmethod
    def from_dict(cls, settings: dict[str, Any]) -> "GridSettings":
        """Of `to_dict`."""
        return cls(**{**settings, "groups": tuple(map(ActionGroup.from_dict, settings["groups"]))})

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return json.loads(json.dumps(asdict(self)))

    def flags(self) -> dict[str, Any]:
        """{flag of the policy: value} that ask for this grid."""
        return {FLAG_NAMES.get(name, name): value for name, value in self.to_dict().items()}
