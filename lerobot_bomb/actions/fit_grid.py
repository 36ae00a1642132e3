"""``lerobot-bomb fit-grid``: the action grid that a policy would fit on a dataset, and what it rounds off.

Shapes: `N` actions, `D` action dims.
"""

import argparse
import textwrap
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from lerobot.configs import NormalizationMode
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION
from PIL import Image

from lerobot_bomb.actions.grid_fit import normalised, normalised_rest
from lerobot_bomb.actions.grid_settings import DECODE_POINTS, GridSettings, default_groups
from lerobot_bomb.actions.grids import ActionGrids
from lerobot_bomb.actions.relative import BOUND_STATISTICS, bounds
from lerobot_bomb.data.columns import dim_names, read_columns, read_meta
from lerobot_bomb.tables import print_table
from lerobot_bomb.viewing.grid_picture import Row, draw_rows
from lerobot_bomb.viewing.unfinished import check_writable, written_whole

UNIFORM = "uniform mid"
LINE_WIDTH = 110  # characters


def add_fit_grid_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``lerobot-bomb fit-grid``."""
    add = parser.add_argument
    add("--dataset.repo_id", dest="repo_id", required=True, help="name of the dataset")
    root = "folder of the dataset (default: LeRobot's, $HF_LEROBOT_HOME/REPO_ID)"
    add("--dataset.root", dest="root", type=Path, help=root)
    distribution = "of the edges: gaussian, uniform or quantile (default: gaussian)"
    add("--policy.grid_distribution", dest="distribution", default="gaussian", help=distribution)
    sigma = "least standard deviation of a coordinate, in its unit (default: 0)"
    add("--policy.grid_min_sigma", dest="min_sigma", type=float, default=0.0, help=sigma)
    add("--picture", type=Path, help="also draw histograms with the edges into this file, as PNG")


def run_fit_grid(args: argparse.Namespace) -> int:
    """Fit, print the tables, draw the picture."""
    if args.picture is not None:
        check_writable("--picture", args.picture)
    meta = read_meta(args.repo_id, args.root)
    low_D, high_D = action_bounds(meta)
    settings = GridSettings(default_groups(len(low_D)), args.distribution, args.min_sigma)
    grids = ActionGrids(settings, len(low_D))
    actions_ND = normalised(read_columns(meta, (ACTION,))[ACTION], low_D, high_D)
    num_clipped = grids.fit(actions_ND, normalised_rest(low_D, high_D))
    actions_ND = actions_ND.clip(-1, 1)
    print(f"{meta.repo_id}: {len(actions_ND)} actions; {num_clipped} are beyond q01..q99 and were clipped")
    names = dim_names(meta.features[ACTION])
    print_fit(grids, names)
    errors = quantisation_errors(grids, actions_ND)
    print_errors("in normalised units, where q01 is -1 and q99 is 1", errors, names)
    physical = {name: error_D * (high_D - low_D) / 2 for name, error_D in errors.items()}
    print_errors("in the dataset's units", physical, names)
    if args.picture is not None:
        picture = draw_rows(picture_rows(grids, actions_ND, names))
        with written_whole(args.picture) as (path,):
            Image.fromarray(picture).save(path, format="PNG")
        print(f"\n{args.picture}")
    return 0


def action_bounds(meta: LeRobotDatasetMetadata) -> tuple[np.ndarray, np.ndarray]:
    """(D,) q01 and (D,) q99 of a dataset's actions.

    Raises:
        ValueError: the dataset has no actions, or no such statistics of them.
    """
    if ACTION not in meta.features:
        raise ValueError(f"dataset {meta.repo_id} has no {ACTION!r}; it has {sorted(meta.features)}")
    statistics = (meta.stats or {}).get(ACTION, {})
    mode = NormalizationMode.QUANTILES
    if not statistics.keys() >= {*BOUND_STATISTICS[mode]}:
        raise ValueError(
            f"dataset {meta.repo_id} has no statistics q01 and q99 of its actions; add them with: python -m "
            f"lerobot.scripts.augment_dataset_quantile_stats --repo-id={meta.repo_id} --root={meta.root}"
        )
    (num_dims,) = meta.features[ACTION]["shape"]
    return bounds(statistics, mode, num_dims)


def quantisation_errors(grids: ActionGrids, actions_ND: np.ndarray) -> dict[str, np.ndarray]:
    """{decode point, or uniform edges with midpoints: mean absolute error (D,)} of normalised actions."""
    uniform = ActionGrids(replace(grids.settings, distribution="uniform", decode_point="mid"), grids.num_dims)
    uniform.fit(actions_ND, grids.rest.numpy())
    of_point = {point: _mean_error(grids, actions_ND, point) for point in DECODE_POINTS}
    return {**of_point, UNIFORM: _mean_error(uniform, actions_ND, "mid")}


def _mean_error(grids: ActionGrids, actions_ND: np.ndarray, point: str) -> np.ndarray:
    """(D,) mean absolute error."""
    decoded_ND = grids.decode(grids.encode(torch.from_numpy(actions_ND)), point).numpy()
    return np.abs(decoded_ND - actions_ND).mean(axis=0)


def print_fit(grids: ActionGrids, names: list[str]) -> None:
    """Print every coordinate's Gaussian and its edges."""
    labels, edges = coordinate_names(grids, names), coordinate_edges(grids)
    print("\nCoordinates, theta and phi in radians")
    print_table(
        ["", "mean", "deviation", "bins"],
        [
            [label, f"{mean:.4g}", f"{std:.4g}", str(len(of) - 1)]
            for label, of, (mean, std) in zip(labels, edges, grids.gaussians.tolist(), strict=True)
        ],
    )
    print("\nEdges")
    for label, of in zip(labels, edges, strict=True):
        text = f"{label}: {' '.join(f'{edge:.4f}' for edge in of)}"
        print(textwrap.fill(text, LINE_WIDTH, subsequent_indent="  "))


def print_errors(unit: str, errors: dict[str, np.ndarray], names: list[str]) -> None:
    """Print a row per dim and a column per way of decoding."""
    print(f"\nMean absolute error of an action that was encoded and decoded, {unit}")
    print_table(
        ["", *errors],
        [[name, *(f"{error_D[i]:.4g}" for error_D in errors.values())] for i, name in enumerate(names)],
    )


def coordinate_names(grids: ActionGrids, names: list[str]) -> list[str]:
    """Of all groups."""
    return [label for group in grids.groups for label in group.coordinate_names(names)]


def coordinate_edges(grids: ActionGrids) -> list[np.ndarray]:
    """(bins + 1,) of each coordinate of all groups."""
    return [of.numpy() for i in range(len(grids.groups)) for of in grids.group_edges(i)]


def picture_rows(grids: ActionGrids, actions_ND: np.ndarray, names: list[str]) -> list[Row]:
    """What a picture shows of every coordinate."""
    values_CN = grids.coordinates(torch.from_numpy(actions_ND).float()).T.numpy()
    rows = zip(
        coordinate_names(grids, names),
        grids.gaussians.tolist(),
        values_CN,
        coordinate_edges(grids),
        strict=True,
    )
    return [
        Row([label, f"mean {mean:.3g}", f"deviation {std:.3g}"], values_N, edges)
        for label, (mean, std), values_N, edges in rows
    ]
