"""Checks for NaN, infinite numbers and images outside [0, 1]; the errors say where."""

import math
from collections.abc import Mapping
from typing import Any, NoReturn

import numpy as np
import torch
from lerobot.utils.constants import ACTION, OBS_IMAGE, OBS_PREFIX
from torch import Tensor, nn

# how far outside [0, 1] an image may be: a quarter of a grey level, for the rounding of a resize
IMAGE_TOLERANCE = 1e-3


def is_finite(values: Tensor) -> bool:
    """Return True if no value is NaN or infinite; for a tensor on CUDA the host waits.

    A sum with a term that is not finite is not finite either. So the values are checked one by one, which
    takes 30 times as long, only if their sum is not finite.
    """
    return bool(_readable(values).sum().isfinite()) or not bool(_bad(values).any())


def require_finite(values: Tensor, name: str, advice: str = "") -> None:
    """Raise a ValueError with count and first index, unless all values are finite."""
    if is_finite(values):
        return
    bad = _bad(values)
    first = f" the first at {bad.nonzero()[0].tolist()}" if bad.ndim else " the only one"
    raise ValueError(
        f"{name} is not finite: {int(bad.sum())} of {bad.numel()} values are NaN or infinite,{first}{advice}"
    )


def _bad(values: Tensor) -> Tensor:
    """Return a mask of the values that are NaN or infinite."""
    return ~_readable(values).isfinite()


def _readable(values: Tensor) -> Tensor:
    """Return 8-bit floats as float32, because torch cannot compute with them."""
    return values.float() if values.is_floating_point() and values.element_size() == 1 else values


def require_finite_on_cpu(values: Tensor, name: str) -> None:
    """Raise unless all values are finite, but only for a tensor on the CPU, where the check costs no wait."""
    if values.device.type == "cpu":
        require_finite(values, name)


def require_finite_weights(model: nn.Module, name: str) -> None:
    """Raise unless all weights and buffers of a model are finite."""
    for key, values in model.state_dict().items():
        require_finite(values, f"{name}: {key}")


def require_finite_statistics(statistics: Mapping[str, Mapping[str, Any]] | None) -> None:
    """Raise unless the dataset's statistics of actions and observations are finite."""
    for key, of_key in (statistics or {}).items():
        if key == ACTION or key.startswith(OBS_PREFIX):
            for statistic, values in of_key.items():
                require_finite(
                    torch.as_tensor(values),
                    f"the dataset's statistics (meta/stats.json): {statistic} of {key!r}",
                    "; once its frames are finite, lerobot-edit-dataset --operation.type=recompute_stats "
                    "makes them anew",
                )


def require_finite_rows(values_NX: np.ndarray | Tensor, failure: str, name: str) -> None:
    """Raise a ValueError with the number of rows that are not finite and the first one's index and values.

    ``failure`` says what cannot be done, ``name`` what the rows are.
    """
    values_NX = values_NX if isinstance(values_NX, Tensor) else torch.from_numpy(values_NX.copy())
    if is_finite(values_NX):
        return
    bad_N = _bad(values_NX).flatten(1).any(dim=1)
    first = int(bad_N.nonzero()[0])
    raise ValueError(
        f"{failure}: {int(bad_N.sum())} of {len(bad_N)} {name} are not finite, the first at index {first}: "
        f"{values_NX[first].tolist()}"
    )


def require_finite_answers(finite_B: Tensor, rows_B: Tensor | None = None) -> None:
    """Raise a ValueError with the rows of a batch for which a model gave numbers that are not finite.

    ``rows_B``: their numbers in the batch, if other than 0..B-1. On CUDA the host waits for the device.
    """
    if bool(finite_B.all()):
        return
    rows = (~finite_B).nonzero()[:, 0] if rows_B is None else rows_B[~finite_B]
    raise ValueError(
        f"the policy's model gives NaN or infinite numbers for the rows {rows.tolist()} of the batch, so "
        "there is no action. If its weights and inputs are finite, numbers grew too large inside it: it has "
        "diverged, or needs --policy.dtype=float32"
    )


def require_finite_batch(values: Mapping[str, Tensor], frames: Mapping[str, Tensor]) -> None:
    """Raise a ValueError with key, row and frame unless a batch (B, ...) is finite, its images in [0, 1].

    On CUDA the host waits for the device once. ``frames``: each row's `episode_index` and `index` in the
    dataset, if it has any; actions (B, T, D) are those of the row's frame and the following ones.
    """
    values = {key: of_key for key, of_key in values.items() if of_key.is_floating_point()}
    if not values:
        return
    device = next(iter(values.values())).device
    ends = torch.stack([_ends(key, of_key).to(device, torch.float32) for key, of_key in values.items()])
    for (key, of_key), (low, high) in zip(values.items(), ends.tolist(), strict=True):
        if not (math.isfinite(low) and math.isfinite(high)):
            _refuse_infinite(key, of_key, frames)
        elif _is_image(key, of_key) and not _is_unit(low, high):
            _refuse_range(key, of_key, frames, low, high)


def _is_image(key: str, values: Tensor) -> bool:
    """Return True for a camera's images (B, 3, H, W); depth, whose keys look the same, has one channel."""
    return key.startswith(OBS_IMAGE) and values.ndim == 4 and values.shape[1] == 3


def _is_unit(low: float, high: float) -> bool:
    return low >= -IMAGE_TOLERANCE and high <= 1 + IMAGE_TOLERANCE


def _ends(key: str, values: Tensor) -> Tensor:
    """Return (2,): an image's least and greatest value, NaN if any is; of other numbers the sum, twice."""
    if _is_image(key, values) and values.numel():
        return torch.stack(torch.aminmax(_readable(values)))
    return values.sum().expand(2)


def _refuse_infinite(key: str, values: Tensor, frames: Mapping[str, Tensor]) -> None:
    """Raise if a value is infinite, but not if only the sum of the values is."""
    bad = _bad(values)
    if not bool(bad.any()):
        return
    row, *place = bad.nonzero()[0].tolist()
    ahead = place[0] if key == ACTION and len(place) == 2 else 0
    where, advice = _frame(frames, row, ahead)
    raise ValueError(
        f"{key!r} is not finite in {where}row {row} of the batch: {int(bad[row].sum())} of "
        f"{bad[row].numel()} values there are NaN or infinite, the first at {place}{advice}"
    )


def _refuse_range(
    key: str, values: Tensor, frames: Mapping[str, Tensor], low: float, high: float
) -> NoReturn:
    is_outside_B = torch.tensor([not _is_unit(*_ends(key, row[None]).tolist()) for row in values])
    row = int(is_outside_B.nonzero()[0])
    where, _ = _frame(frames, row, 0)
    raise ValueError(
        f"{key!r} has values from {low:.4g} to {high:.4g}, the first such image in {where}row {row} of the "
        "batch; images must lie in [0, 1], as LeRobot's datasets and environments give them: divide 0..255 "
        "by 255"
    )


def _frame(frames: Mapping[str, Tensor], row: int, ahead: int) -> tuple[str, str]:
    """Describe where in the dataset a row's frame is (or the one `ahead` frames later), and what to do."""
    if not {"episode_index", "index"} <= frames.keys():
        return "", ""
    episode, index = (int(frames[key].reshape(-1)[row]) for key in ("episode_index", "index"))
    where = f"frame {index + ahead} of the dataset (its column 'index'), of episode {episode}, "
    advice = "leave the episode out: lerobot-edit-dataset --operation.type=delete_episodes"
    return where, f"; {advice} --operation.episode_indices=[{episode}]"
