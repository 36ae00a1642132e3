"""Settings of a grid: which action dims share a token, in which coordinates, cut where."""

import json
import math
import re
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
JOINT_BINS = 256  # one joint per token: 16 x 16 x 16 for three joints leave errors of degrees
MAX_BINS = 4096  # of a coordinate
LAYOUTS = ("pose", "joints")
FLAG = "--policy.action_groups"
LAYOUT_FLAG = "--policy.action_layout"
# policy flags whose names differ from the fields of `GridSettings`
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
        """Build a group from its JSON."""
        keys = {"dims", "transform", "bins"}
        if set(group) != keys:
            raise ValueError(f"{FLAG}: {group} must have exactly the keys {sorted(keys)}")
        return cls(tuple(group["dims"]), group["transform"], tuple(group["bins"]))

    @property
    def num_cells(self) -> int:
        return math.prod(self.bins)

    def coordinate_names(self, dim_names: Sequence[str]) -> list[str]:
        """Return the names of the group's coordinates, given the names of all action dims."""
        return [*POLAR_COORDINATES] if self.transform == "polar" else [dim_names[dim] for dim in self.dims]


def default_groups(
    num_dims: int, names: Sequence[str] | None = None, layout: str | None = None
) -> tuple[ActionGroup, ...]:
    """Return the default groups of an action.

    A pose has SpatialVLA's groups: direction and length of x, y, z, then three angles and a binary gripper
    (7 dims) or a gripper in `LINEAR_BINS` (4). Two dims share a token. Otherwise each dim is a token of
    `JOINT_BINS`.

    Args:
        num_dims: number of action dims.
        names: names of the dims, which tell whether the action is a pose.
        layout: one of `LAYOUTS`; overrides the names.

    Raises:
        ValueError: no pose has so many dims, or 7 dims may be a pose or seven joints.
    """
    layout = layout or _named_layout(num_dims, list(names or []))
    if layout == "pose":
        if num_dims not in (4, 7):
            raise ValueError(
                f"{LAYOUT_FLAG}=pose is x, y, z, gripper or x, y, z, three angles, gripper; the action has "
                f"{num_dims} dims. Give {LAYOUT_FLAG}=joints or {FLAG}"
            )
        position = ActionGroup((0, 1, 2), "polar", POLAR_BINS)
        if num_dims == 4:
            return (position, _linear(3))
        return (position, _linear(3, 4, 5), ActionGroup((6,), "binary", (2,)))
    if num_dims == 2:
        return (ActionGroup((0, 1), "identity", (64, 64)),)
    return tuple(ActionGroup((dim,), "identity", (JOINT_BINS,)) for dim in range(num_dims))


def _named_layout(num_dims: int, names: list[str]) -> str:
    """Return the layout that the names imply; four unnamed dims are a pose, and none becomes binary."""
    if num_dims not in (4, 7):
        return "joints"
    words = [re.findall("[a-z]+", name.lower()) for name in names]
    is_position = len(words) == num_dims and all(
        not {axis, f"d{axis}", f"delta{axis}"}.isdisjoint(name_words)
        for axis, name_words in zip("xyz", words[:3], strict=True)
    )
    if is_position and "grip" in names[-1].lower():
        return "pose"
    # "motor_0" to "motor_6" may be anything
    tells = not is_position and (len({*map(tuple, words)}) > 1 or "joint" in "".join(names).lower())
    if tells:
        return "joints"
    if num_dims == 4:
        return "pose"
    raise ValueError(
        f"{LAYOUT_FLAG} is not given, and the names of the 7 action dims ({', '.join(names) or 'none'}) do "
        f"not say what they are. Give {LAYOUT_FLAG}=pose for x, y, z, three angles and a gripper that is "
        f"open or closed, {LAYOUT_FLAG}=joints for seven joints, or {FLAG}"
    )


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
    """Settings that a grid is fitted with; `ActionGrids` holds the result of the fit."""

    groups: tuple[ActionGroup, ...]
    # of the edges: equal shares of a Gaussian, equal widths, equal shares of the samples
    distribution: str = "gaussian"
    # least standard deviation of a coordinate's Gaussian
    min_sigma: float = 0.0
    # what a cell is decoded to: its middle; the means of its bins; the mean of the samples in it
    decode_point: str = "cond_mean"
    # whether the polar groups' first bin of rho means "no motion" exactly
    zero_radius_bin: bool = True
    # rho, in normalised units, below which that is so; None = REST_SHARE of the samples' long motions
    rho_dead: float | None = None
    # whether phi is cut opposite the samples' mean direction, or at pi
    phi_fit: str = "wrapped"

    def __post_init__(self) -> None:
        one_of("--policy.grid_distribution", self.distribution, DISTRIBUTIONS)
        one_of("--policy.decode_point", self.decode_point, DECODE_POINTS)
        one_of("--policy.phi_fit", self.phi_fit, PHI_FITS)
        if not 0 <= self.min_sigma < math.inf:
            raise ValueError(f"--policy.grid_min_sigma={self.min_sigma} must be a number of at least 0")
        if self.rho_dead is not None and not 1e-3 <= self.rho_dead <= 0.5:
            raise ValueError(
                f"--policy.rho_dead={self.rho_dead} must be in [0.001, 0.5], or null to follow the data"
            )

    @classmethod
    def from_dict(cls, settings: dict[str, Any]) -> "GridSettings":
        """Build the settings from what `to_dict` returns."""
        return cls(**{**settings, "groups": tuple(map(ActionGroup.from_dict, settings["groups"]))})

    def to_dict(self) -> dict[str, Any]:
        """Return the settings as JSON values."""
        return json.loads(json.dumps(asdict(self)))

    def flags(self) -> dict[str, Any]:
        """{policy flag: value} that request this grid."""
        return {FLAG_NAMES.get(name, name): value for name, value in self.to_dict().items()}
