"""Action grid that a policy would fit on a dataset, and its rounding errors.

Shapes: `N` actions, `D` action dims.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import NormalizationMode
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION
from PIL import Image

from lerobot_bomb.actions.grid_fit import normalised, normalised_rest
from lerobot_bomb.actions.grid_report import (
    clipping_text,
    coordinate_edges,
    coordinate_names,
    edges_text,
    rest_text,
)
from lerobot_bomb.actions.grid_settings import (
    DECODE_POINTS,
    LAYOUT_FLAG,
    LAYOUTS,
    ActionGroup,
    GridSettings,
    default_groups,
)
from lerobot_bomb.actions.grids import ActionGrids
from lerobot_bomb.actions.relative import BOUND_STATISTICS, bounds
from lerobot_bomb.data.columns import dim_names, read_columns, read_meta
from lerobot_bomb.files import written_whole
from lerobot_bomb.flags import one_of
from lerobot_bomb.tables import print_table
from lerobot_bomb.viewing.grid_plot import PlotRow, draw_rows

UNIFORM, CLIPPING = "uniform mid", "clipping alone"


def show_fit(
    repo_id: str,
    root: Path | None,
    action_groups: Sequence[dict[str, Any]] | None,
    layout: str | None,
    mapping: dict[str, str],
    options: dict[str, Any],
    plot: Path | None,
) -> None:
    """Fit a grid on a dataset, print the tables, draw the plot; arguments are the flags of these names.

    Raises:
        ValueError: a setting is wrong, or the dataset lacks the statistics.
    """
    mode = mapping.get("ACTION", NormalizationMode.MIN_MAX)
    one_of("--policy.normalization_mapping[ACTION]", mode, [allowed.value for allowed in BOUND_STATISTICS])
    mode = NormalizationMode(mode)
    meta = read_meta(repo_id, root)
    low_D, high_D = dataset_action_bounds(meta, mode)
    num_dims, names = len(low_D), dim_names(meta.features[ACTION])
    if layout is not None:
        one_of(LAYOUT_FLAG, layout, LAYOUTS)
    groups = (
        default_groups(num_dims, names, layout)
        if action_groups is None
        else tuple(map(ActionGroup.from_dict, action_groups))
    )
    grids = ActionGrids(GridSettings(groups, **options), num_dims)
    actions_ND = normalised(read_columns(meta, (ACTION,))[ACTION], low_D, high_D)
    grids.fit(actions_ND, normalised_rest(low_D, high_D))
    print(f"{meta.repo_id}: {len(actions_ND)} actions, -1 and 1 at {' and '.join(BOUND_STATISTICS[mode])}")
    print(clipping_text(actions_ND, names)[0])
    if rest := rest_text(grids, actions_ND, names)[0]:
        print(rest)
    print_fit(grids, names)
    errors = quantisation_errors(grids, actions_ND)
    print_errors("in normalised units", errors, names)
    physical = {name: error_D * (high_D - low_D) / 2 for name, error_D in errors.items()}
    print_errors("in the dataset's units", physical, names)
    if plot is not None:
        _write_plot(plot, meta.repo_id, grids, actions_ND, names)


def _write_plot(
    plot: Path, repo_id: str, grids: ActionGrids, actions_ND: np.ndarray, names: list[str]
) -> None:
    title = f"{repo_id}: {len(actions_ND)} actions and the {grids.settings.distribution} bins of a grid"
    drawn = draw_rows(title, plot_rows(grids, actions_ND.clip(-1, 1), names))
    with written_whole(plot) as (path,):
        Image.fromarray(drawn).save(path, format="PNG")
    print(f"\n{plot}")


def dataset_action_bounds(
    meta: LeRobotDatasetMetadata, mode: NormalizationMode
) -> tuple[np.ndarray, np.ndarray]:
    """Return the actions that become -1 and those that become 1, (D,) each.

    Raises:
        ValueError: the dataset has no actions, or lacks the statistics of them.
    """
    if ACTION not in meta.features:
        raise ValueError(f"dataset {meta.repo_id} has no {ACTION!r}; it has {sorted(meta.features)}")
    (num_dims,) = meta.features[ACTION]["shape"]
    return bounds((meta.stats or {}).get(ACTION, {}), mode, num_dims)


def quantisation_errors(grids: ActionGrids, actions_ND: np.ndarray) -> dict[str, np.ndarray]:
    """Return mean absolute errors (D,) of normalised actions, clipping included.

    There is one for each decode point, for uniform edges with midpoints, and for clipping alone.
    """
    uniform = ActionGrids(replace(grids.settings, distribution="uniform", decode_point="mid"), grids.num_dims)
    uniform.fit(actions_ND, grids.rest.numpy())
    of_point = {point: _mean_error(grids, actions_ND, point) for point in DECODE_POINTS}
    return {
        **of_point,
        UNIFORM: _mean_error(uniform, actions_ND, "mid"),
        CLIPPING: np.abs(actions_ND.clip(-1, 1) - actions_ND).mean(axis=0),
    }


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
            [label, f"{mean:.4g}", f"{std:.4g}", str(len(label_edges) - 1)]
            for label, label_edges, (mean, std) in zip(labels, edges, grids.gaussians.tolist(), strict=True)
        ],
    )
    print(f"\nEdges\n{edges_text(grids, names)}")


def print_errors(unit: str, errors: dict[str, np.ndarray], names: list[str]) -> None:
    """Print a row per dim and a column per way of decoding."""
    print(f"\nMean absolute error of an action that was encoded and decoded, {unit}")
    print_table(
        ["", *errors],
        [[name, *(f"{error_D[i]:.4g}" for error_D in errors.values())] for i, name in enumerate(names)],
    )


def plot_rows(grids: ActionGrids, actions_ND: np.ndarray, names: list[str]) -> list[PlotRow]:
    """Return the rows of a plot, one for each coordinate."""
    values_CN = grids.coordinates(torch.from_numpy(actions_ND).float()).T.numpy()
    rows = zip(
        coordinate_names(grids, names),
        grids.gaussians.tolist(),
        values_CN,
        coordinate_edges(grids),
        strict=True,
    )
    return [
        PlotRow([label, f"mean {mean:.3g}", f"deviation {std:.3g}"], values_N, edges)
        for label, (mean, std), values_N, edges in rows
    ]
