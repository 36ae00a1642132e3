"""Absolute actions <-> actions relative to the current state.

Shapes: `B` batch, `T` actions of a chunk, `D` action dims, `S` state dims, `N` frames.
"""

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from lerobot.configs import NormalizationMode
from torch import Tensor, nn

from lerobot_bomb.finite import require_finite, require_finite_rows

# statistics that LeRobot's normaliser maps to -1 and 1
BOUND_STATISTICS = {
    NormalizationMode.MIN_MAX: ("min", "max"),
    NormalizationMode.QUANTILES: ("q01", "q99"),
    NormalizationMode.QUANTILE10: ("q10", "q90"),
}
CENTRE_AND_DISTANCE = ("mean", "std")
type Statistics = dict[str, np.ndarray]  # (D,) each, by name

QUANTILE = 0.999  # of the residuals' sizes; larger ones saturate where normalised values are bounded
MAX_RESIDUALS = 20_000_000  # a dimension; of more, evenly spaced frames are taken


def bounds(statistics: Statistics, mode: NormalizationMode, num_dims: int) -> tuple[np.ndarray, np.ndarray]:
    """(D,) values that become -1 and (D,) values that become 1 when LeRobot normalises.

    Raises:
        ValueError: the dataset lacks the statistics of the mode, or they are not finite.
    """
    if mode is NormalizationMode.IDENTITY:
        return -np.ones(num_dims), np.ones(num_dims)
    names = CENTRE_AND_DISTANCE if mode is NormalizationMode.MEAN_STD else BOUND_STATISTICS[mode]
    if missing := [name for name in names if name not in statistics]:
        raise ValueError(
            f"--policy.normalization_mapping: {mode.value} needs the statistics {', '.join(missing)}, which "
            f"the dataset lacks; it has {', '.join(sorted(statistics))}. MIN_MAX needs no quantiles, "
            "`lerobot-bomb doctor dataset FOLDER --mend` adds them"
        )
    low, high = (np.asarray(statistics[name], dtype=np.float64) for name in names)
    for name, values in zip(names, (low, high), strict=True):
        require_finite(torch.from_numpy(values), f"the dataset's statistic {name}")
    return (low - high, low + high) if names is CENTRE_AND_DISTANCE else (low, high)


def named_dims(names: Sequence[str], wanted: Iterable[str], flag: str) -> list[int]:
    """Indices of the dimensions whose name contains one of the wanted texts, whatever their case.

    Raises:
        ValueError: a text is in no name.
    """
    found: set[int] = set()
    for text in wanted:
        matches = {i for i, name in enumerate(names) if text and text.lower() in name.lower()}
        if not matches:
            raise ValueError(f"{flag}: no action dimension is called {text!r}; there are {', '.join(names)}")
        found |= matches
    return sorted(found)


class RelativeActions(nn.Module):
    """Normalised actions (B, T, D) <-> scaled residuals to the state that the chunk starts from.

    residual = (action - (gain * state + bias)) / scale, where gain and bias put the normalised state into
    the action's normalisation, so that "stay" is exactly 0. Dimensions that stay absolute have gain and
    bias 0 and scale 1. Until `fit`, state and action are taken to be normalised alike.
    """

    gain: Tensor  # (D,)
    bias: Tensor  # (D,)
    scale: Tensor  # (D,)
    state_indices: Tensor  # (D,) int64

    def __init__(self, num_dims: int, state_of_dim: dict[int, int]):
        """``state_of_dim``: {action dimension that is relative: its state dimension}."""
        super().__init__()
        self.state_of_dim = state_of_dim
        relative = torch.zeros(num_dims)
        relative[list(state_of_dim)] = 1
        state_indices = torch.tensor([state_of_dim.get(dim, 0) for dim in range(num_dims)])
        self.register_buffer("state_indices", state_indices, persistent=False)
        self.register_buffer("gain", relative)
        self.register_buffer("bias", torch.zeros(num_dims))
        self.register_buffer("scale", 1 + relative)  # two values in [-1, 1] differ by at most 2

    def encode(self, actions_BTD: Tensor, state_BS: Tensor) -> Tensor:
        """Absolute actions (B, T, D) -> residuals (B, T, D) to the state (B, S)."""
        return (actions_BTD - self._anchor(state_BS)) / self.scale

    def decode(self, residuals_BTD: Tensor, state_BS: Tensor) -> Tensor:
        """Residuals (B, T, D) to the state (B, S) -> absolute actions (B, T, D)."""
        return residuals_BTD * self.scale + self._anchor(state_BS)

    def _anchor(self, state_BS: Tensor) -> Tensor:
        return (self.gain * state_BS.float()[:, self.state_indices] + self.bias)[:, None]

    def fit(
        self,
        actions_ND: np.ndarray,
        states_NS: np.ndarray,
        episode_ends_N: np.ndarray,
        chunk_size: int,
        action_bounds: tuple[np.ndarray, np.ndarray],
        state_bounds: tuple[np.ndarray, np.ndarray],
        mode: NormalizationMode = NormalizationMode.MIN_MAX,
    ) -> None:
        """Take gain and bias from the normalisers' bounds, scale from the data's own residuals.

        Residuals are as large as actions that are normalised by ``mode``: of root mean square 1 for MEAN_STD,
        else within [-1, 1]. ``episode_ends_N``: for each frame the index after its episode's last one. A
        dimension whose action never changes stays absolute.

        Raises:
            ValueError: actions or states are not finite, or the state of a dimension does not track its
                action.
        """
        require_finite_rows(actions_ND, "relative actions cannot be fitted", "actions")
        require_finite_rows(states_NS, "relative actions cannot be fitted", "states")
        for dim, state_dim in self.state_of_dim.items():
            low, high = action_bounds[0][dim], action_bounds[1][dim]
            if high == low:
                self.gain[dim], self.bias[dim], self.scale[dim] = 0, 0, 1
                continue
            actions_N, states_N = actions_ND[:, dim], states_NS[:, state_dim]
            _require_tracking(actions_N, states_N, episode_ends_N, dim, state_dim)
            state_low, state_high = state_bounds[0][state_dim], state_bounds[1][state_dim]
            self.gain[dim] = float((state_high - state_low) / (high - low))
            self.bias[dim] = float((state_high + state_low - high - low) / (high - low))
            residuals = _residuals(actions_N, states_N, episode_ends_N, chunk_size)
            self.scale[dim] = float(_size(residuals, mode) * 2 / (high - low)) or 1.0


def _require_tracking(
    actions_N: np.ndarray, states_N: np.ndarray, episode_ends_N: np.ndarray, dim: int, state_dim: int
) -> None:
    """Raise a ValueError unless the action varies less around this or the next state than by itself."""
    following_N = np.minimum(np.arange(len(states_N)) + 1, episode_ends_N - 1)
    spread = float(actions_N.std())
    distance = min(float((actions_N - followed_N).std()) for followed_N in (states_N, states_N[following_N]))
    if not distance < spread:
        raise ValueError(
            f"--policy.relative_actions=true: action dimension {dim} does not follow state dimension "
            f"{state_dim} (standard deviation {spread:.3g}, and {distance:.3g} around the state). Actions "
            f"that are already differences (delta control) must stay absolute: give "
            f"--policy.relative_actions=false, or name such dimensions in --policy.relative_exclude_joints, "
            f"or the right state dimensions in --policy.relative_state_indices"
        )


def _size(residuals_N: np.ndarray, mode: NormalizationMode) -> float:
    """Return the size of a residual that is scaled to 1."""
    if mode is NormalizationMode.MEAN_STD:
        return float(np.sqrt(np.square(residuals_N).mean()))
    return float(np.quantile(np.abs(residuals_N), QUANTILE))


def _residuals(
    actions_N: np.ndarray, states_N: np.ndarray, episode_ends_N: np.ndarray, chunk_size: int
) -> np.ndarray:
    """Action minus state, for all actions of the chunks that start at evenly spaced frames."""
    stride = 1 + len(actions_N) * chunk_size // MAX_RESIDUALS
    starts = np.arange(0, len(actions_N), stride)
    parts = []
    for offset in range(chunk_size):
        inside = starts[starts + offset < episode_ends_N[starts]]
        parts.append(actions_N[inside + offset] - states_N[inside])
    return np.concatenate(parts)
