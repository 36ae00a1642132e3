"""A checkpoint's loss, accuracy and L1 on recorded frames.

Shapes: `R` frames that are measured.
"""

from dataclasses import dataclass

import numpy as np
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import ACTION

from lerobot_bomb.bootstrap import Estimate, estimate_mean
from lerobot_bomb.data.columns import dim_names
from lerobot_bomb.evaluation.measures import L1, measure_l1
from lerobot_bomb.evaluation.predictions import load_dataset, load_network, predict
from lerobot_bomb.evaluation.splits import (
    Split,
)
from lerobot_bomb.evaluation.trivial import Demonstrations
from lerobot_bomb.tables import print_table

POLICY = "policy"
SHOWN_STEPS = (1, 2, 3, 5, 10, 20, 50, 100)  # of the chunk, in the printed table


@dataclass(frozen=True)
class Column:
    """A split's column of the table; `l1` is {policy or trivial predictor: its L1}."""

    episodes: list[int]
    num_frames: int
    num_frames_measured: int
    losses: dict[str, Estimate]
    l1: dict[str, L1]


def measure_columns(
    config: PreTrainedConfig,
    meta: LeRobotDatasetMetadata,
    split: Split,
    max_frames: int,
    batch_size: int,
) -> dict[str, Column]:
    """{train, validation: its column}; a split without episodes has none."""
    policy = load_network(config)
    dataset = load_dataset(config, meta, sorted({*split.train, *split.validation}))
    demonstrations = Demonstrations.read(meta, sorted({*split.train, *split.validation}), split.train)
    columns = {}
    for name, episodes in {"train": split.train, "validation": split.validation}.items():
        if episodes:
            rows = np.flatnonzero(np.isin(demonstrations.episode_index, episodes))
            rows_R = evenly_spaced(rows, max_frames)
            losses, l1 = _measure(policy, dataset, demonstrations, rows_R, batch_size, name)
            columns[name] = Column(episodes, len(rows), len(rows_R), losses, l1)
    return columns


def evenly_spaced(rows_N: np.ndarray, max_rows: int) -> np.ndarray:
    """Return at most ``max_rows`` of the rows, from the first to the last; 0 means all."""
    if max_rows == 0 or len(rows_N) <= max_rows:
        return rows_N
    return rows_N[np.linspace(0, len(rows_N) - 1, max_rows).round().astype(int)]


def _measure(
    policy: PreTrainedPolicy,
    dataset: LeRobotDataset,
    demonstrations: Demonstrations,
    rows_R: np.ndarray,
    batch_size: int,
    name: str,
) -> tuple[dict[str, Estimate], dict[str, L1]]:
    """Measure losses, and L1 of the policy and of the trivial predictors."""
    predictions = predict(policy, dataset, rows_R, batch_size, name)
    chunk_size = predictions.chunks.shape[1]
    recorded_RTD, is_pad_RT = demonstrations.recorded(rows_R, chunk_size)
    chunks = {POLICY: predictions.chunks, **demonstrations.trivial(rows_R, chunk_size)}
    episode_R, dims = demonstrations.episode_index[rows_R], dim_names(dataset.features[ACTION])
    return (
        {key: estimate_mean(values_R, episode_R) for key, values_R in predictions.losses.items()},
        {
            key: measure_l1(chunks_RTD, recorded_RTD, is_pad_RT, episode_R, dims)
            for key, chunks_RTD in chunks.items()
        },
    )


def print_columns(columns: dict[str, Column]) -> None:
    """Print the columns side by side, and the last one's L1 by step of the chunk."""
    shown = list(columns.values())
    rows = [
        ["episodes", *(str(len(column.episodes)) for column in shown)],
        ["frames", *(f"{column.num_frames_measured} of {column.num_frames}" for column in shown)],
    ]
    for name in shown[-1].losses:
        label = name if name == "loss" else f"forward: {name}"
        rows.append([label, *(_text(column.losses.get(name)) for column in shown)])
    for name, l1 in shown[-1].l1.items():
        rows.append([f"L1, {name}", *(str(column.l1[name].all) for column in shown)])
        if name == POLICY and len(l1.dims) > 1:
            rows += [[f"  {dim}", *(str(column.l1[name].dims[dim]) for column in shown)] for dim in l1.dims]
    print_table(["", *columns], rows)
    l1 = shown[-1].l1
    num_steps = len(l1[POLICY].steps)
    steps = sorted({step for step in SHOWN_STEPS if step < num_steps} | {num_steps})
    print(f"\nL1 by step of the chunk, {list(columns)[-1]}")
    print_table(
        ["step", *l1],
        [[str(step), *(f"{errors.steps[step - 1].mean:.4g}" for errors in l1.values())] for step in steps],
    )
    print("\n[95 % bootstrap interval over episodes]; L1 of decoded actions, in the dataset's units")


def _text(estimate: Estimate | None) -> str:
    return "-" if estimate is None else str(estimate)
