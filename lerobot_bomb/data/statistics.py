"""Statistics of a dataset's numbers over all of its frames.

LeRobot averages quantiles over episodes and over datasets that it merges, so that a third of the frames may
lie beyond q01..q99. Its statistics of images stay: their quantiles are means over sampled pixels.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from lerobot.utils.constants import DEFAULT_FEATURES

from lerobot_bomb.data.dataset_files import (
    PICTURES,
    STATISTICS_FILE,
    Info,
    check_finite_columns,
    flat_numbers,
    read_episodes,
    read_info,
    read_parquet,
)
from lerobot_bomb.files import read_json, written_whole

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
TOLERANCE = 1e-3  # of a dimension's range, which LeRobot divides into 5000 bins

type Statistics = dict[str, np.ndarray]


@dataclass(frozen=True)
class WrongStatistics:
    """Statistics of a feature that are not those of all frames."""

    feature: str
    names: tuple[str, ...]
    shares_outside: np.ndarray  # (D,) share of the frames beyond the stored q01..q99; NaN: not stored

    def __str__(self) -> str:
        text = f"{self.feature}: {', '.join(self.names)} are missing or not those of all frames"
        if np.isnan(self.shares_outside).any():
            return text
        shares = ", ".join(f"{share:.1%}" for share in self.shares_outside)
        return f"{text}; of these, by dimension, {shares} lie beyond q01..q99"


def exact_statistics(values_ND: np.ndarray) -> Statistics:
    """(N, D) frames -> (D,) min, max, mean, std and quantiles, and (1,) count."""
    values_ND = values_ND.astype(np.float64)
    quantiles = np.quantile(values_ND, [*QUANTILES.values()], axis=0)
    return {
        "min": values_ND.min(axis=0),
        "max": values_ND.max(axis=0),
        "mean": values_ND.mean(axis=0),
        "std": values_ND.std(axis=0),
        "count": np.array([len(values_ND)]),
        **dict(zip(QUANTILES, quantiles, strict=True)),
    }


def wrong_statistics(root: Path) -> list[WrongStatistics]:
    """Compare a dataset's stats.json with all of its frames, images excepted.

    Raises:
        OSError, ValueError: a file is missing or damaged, or not all frames are here.
    """
    stored, found = read_json(root / STATISTICS_FILE), []
    for name, values_ND in _numbers(root, read_info(root)):
        exact, of_feature = exact_statistics(values_ND), stored.get(name, {})
        tolerance = _tolerance(exact)
        wrong = [
            each
            for each in exact
            if each not in of_feature or not _is_close(of_feature[each], exact[each], tolerance)
        ]
        if wrong:
            low, high = (np.asarray(of_feature.get(each, np.nan)) for each in ("q01", "q99"))
            is_outside_ND = (values_ND < low - tolerance) | (values_ND > high + tolerance)
            shares = np.where(np.isnan(low + high), np.nan, is_outside_ND.mean(axis=0))
            found.append(WrongStatistics(name, tuple(wrong), shares))
    return found


def check_statistics(root: Path) -> None:
    """Raise a ValueError if statistics of a dataset's numbers are not those of all frames."""
    if wrong := wrong_statistics(root):
        raise ValueError(f"{root / STATISTICS_FILE}: {wrong[0]}; {mending(root)}")


def mending(root: Path) -> str:
    """Name the command that mends a dataset's statistics."""
    return f"`lerobot-bomb doctor dataset {root} --mend` writes those of all frames"


def write_statistics(root: Path) -> None:
    """Write statistics of all frames to a dataset's stats.json; those of images stay.

    Raises:
        OSError, ValueError: a file is missing or damaged, or not all frames are here.
    """
    path = root / STATISTICS_FILE
    stored: dict[str, Any] = read_json(path)
    for name, values_ND in _numbers(root, read_info(root)):
        stored[name] = {each: values.tolist() for each, values in exact_statistics(values_ND).items()}
    with written_whole(path) as (unfinished,):
        unfinished.write_text(json.dumps(stored, indent=4, sort_keys=True))


def write_image_statistics(root: Path) -> None:
    """Write image statistics of all episodes to stats.json, however blocks held them.

    Raises:
        OSError, ValueError: a file is missing or damaged.
    """
    from lerobot.datasets.compute_stats import aggregate_feature_stats  # imports torch: seconds

    path, info = root / STATISTICS_FILE, read_info(root)
    stored: dict[str, Any] = read_json(path)
    episodes = read_episodes(root, info)
    for name, feature in info["features"].items():
        if feature["dtype"] not in PICTURES:
            continue
        shapes = {each: np.shape(values) for each, values in stored[name].items()}
        columns = {
            each: flat_numbers(episodes[f"stats/{name}/{each}"]).reshape(len(episodes), *shape)
            for each, shape in shapes.items()
        }
        of_episodes = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        merged: dict[str, Any] = aggregate_feature_stats(of_episodes)
        stored[name] = {each: values.tolist() for each, values in merged.items()}
    with written_whole(path) as (unfinished,):
        unfinished.write_text(json.dumps(stored, indent=4, sort_keys=True))


def _tolerance(exact: Statistics) -> np.ndarray:
    """(D,) error that LeRobot's histograms and float32 may have."""
    size_D = np.maximum(np.abs(exact["min"]), np.abs(exact["max"]))
    return 1e-6 + 1e-5 * size_D + TOLERANCE * (exact["max"] - exact["min"])


def _is_close(stored: Any, exact_D: np.ndarray, tolerance_D: np.ndarray) -> bool:
    values = np.asarray(stored, dtype=np.float64)
    return values.shape == exact_D.shape and bool((np.abs(values - exact_D) <= tolerance_D).all())


def _numbers(root: Path, info: Info) -> Iterator[tuple[str, np.ndarray]]:
    """Yield each vector that a policy may normalise: its name and (N, D) of all frames."""
    paths = sorted((root / "data").rglob("*.parquet"))
    for name, feature in info["features"].items():
        is_text = feature["dtype"] in (*PICTURES, "string", "language")
        if name in DEFAULT_FEATURES or is_text or len(feature["shape"]) != 1:
            continue
        tables: list[pa.Table] = [read_parquet(path, [name]) for path in paths]
        num_frames = sum(map(len, tables))
        if num_frames != info["total_frames"]:
            raise ValueError(f"{root} holds {num_frames} of the dataset's {info['total_frames']} frames")
        table = pa.concat_tables(tables)
        check_finite_columns(root / "data", table)
        yield name, flat_numbers(table[name]).reshape(num_frames, *feature["shape"])
