"""``lerobot-bomb checkpoint fit-grid`` on recorded and converted demonstrations."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import NormalizationMode
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION
from PIL import Image
from pusht_cases import REPO_ID as PUSHT

from lerobot_bomb.actions.grid_fit import normalised, normalised_rest
from lerobot_bomb.actions.grid_settings import GridSettings, default_groups
from lerobot_bomb.actions.grids import ActionGrids
from lerobot_bomb.commands.main import main
from lerobot_bomb.data.columns import read_columns
from lerobot_bomb.data.record import record
from lerobot_bomb.data.recording import Recording
from lerobot_bomb.viewing.fitted_grid import CLIPPING, UNIFORM, dataset_action_bounds, quantisation_errors
from lerobot_bomb.viewing.grid_plot import (
    BAR_RGB,
    EDGE_RGB,
    ROW_HEIGHT,
    TITLE_HEIGHT,
    PlotRow,
    draw_rows,
    edge_x,
)

REPO_ID = "test/grid"
QUANTILES = '--policy.normalization_mapping={"ACTION": "QUANTILES"}'


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record four episodes of BOMB, about 20 frames each."""
    path = tmp_path_factory.mktemp("grid") / "dataset"
    record(Recording(REPO_ID, episodes=4, seed=0, image_size=32, images=True), path)
    return path


def fit_grid(root: Path, *flags: str, repo_id: str = REPO_ID) -> int:
    return main(["checkpoint", "fit-grid", f"--dataset.repo_id={repo_id}", f"--dataset.root={root}", *flags])


def table(text: str, title: str) -> dict[str, dict[str, float]]:
    """{row: {column: number}} of the printed table under a title."""
    lines = text[text.index(title) :].splitlines()[1:]
    header = re.split(r"\s{2,}", lines[0].strip())
    rows = [line.split() for line in lines[1 : lines.index("") if "" in lines else None]]
    return {name: dict(zip(header, map(float, cells), strict=True)) for name, *cells in rows}


def fitted(meta: LeRobotDatasetMetadata) -> tuple[ActionGrids, np.ndarray, float | np.ndarray]:
    """The default grid of a dataset, its normalised actions (N, D) and their unit (D,)."""
    low, high = dataset_action_bounds(meta, NormalizationMode.MIN_MAX)
    actions = normalised(read_columns(meta, (ACTION,))[ACTION], low, high)
    grids = ActionGrids(GridSettings(default_groups(len(low))), len(low))
    grids.fit(actions, normalised_rest(low, high))
    return grids, actions, (high - low) / 2


def test_the_tables_are_the_errors_of_recorded_actions(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fit_grid(root) == 0
    text = capsys.readouterr().out
    grids, actions, unit = fitted(LeRobotDatasetMetadata(REPO_ID, root=root))
    assert text.startswith(f"{REPO_ID}: {len(actions)} actions, -1 and 1 at min and max\nnone of ")
    errors = quantisation_errors(grids, actions)
    names = ["dx", "dy", "dz", "gripper"]
    for title, scale in (("in normalised units", np.ones(4)), ("in the dataset's units", unit)):
        shown = table(text, title)
        for column, error_D in errors.items():
            values = [shown[name][column] for name in names]
            assert values == pytest.approx(error_D * scale, rel=1e-3), column
    fit = table(text, "Coordinates, theta and phi in radians")
    assert {name: row["bins"] for name, row in fit.items()} == {
        "theta": 16,
        "phi": 32,
        "rho": 8,
        "gripper": 16,
    }
    rho = grids.group_edges(0)[2].tolist()
    assert f"rho: {' '.join(f'{edge:.4f}' for edge in rho)}\n" in text
    assert fit["rho"]["mean"] == pytest.approx(grids.gaussians[2, 0].item(), rel=1e-3)


def test_recorded_actions_come_back_nearer_than_with_midpoints(root: Path) -> None:
    grids, actions, _ = fitted(LeRobotDatasetMetadata(REPO_ID, root=root))
    errors = {name: error_D.mean() for name, error_D in quantisation_errors(grids, actions).items()}
    assert errors["centroid"] < errors["cond_mean"] < 0.7 * min(errors["mid"], errors[UNIFORM])


def test_pusht_has_two_coordinates_in_pixels(pusht_dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert fit_grid(pusht_dataset, "--policy.grid_distribution=quantile", repo_id=PUSHT) == 0
    text = capsys.readouterr().out
    normal, pixels = (table(text, title) for title in ("in normalised units", "in the dataset's units"))
    low, high = dataset_action_bounds(
        LeRobotDatasetMetadata(PUSHT, root=pusht_dataset), NormalizationMode.MIN_MAX
    )
    for dim, name in enumerate(["target_x", "target_y"]):
        ratio = pixels[name]["cond_mean"] / normal[name]["cond_mean"]
        assert ratio == pytest.approx((high - low)[dim] / 2, rel=1e-3)
        assert pixels[name]["cond_mean"] < 2.5  # pixels of 512


def test_errors_include_what_quantiles_clip(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Check a dimension far beyond the quantiles, where clipping is nearly all of the error."""
    root = edited(root, tmp_path / "averaged", q01="q10", q99="q90")
    assert fit_grid(root, QUANTILES) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "actions are beyond the grid and are clipped to it" in text and "MIN_MAX clips nothing" in text
    assert "`lerobot-bomb doctor dataset FOLDER --mend` makes them so" in text
    assert fit_grid(root, QUANTILES) == 0
    text = capsys.readouterr().out
    shown = table(text, "in the dataset's units")
    meta = LeRobotDatasetMetadata(REPO_ID, root=root)
    low, high = dataset_action_bounds(meta, NormalizationMode.QUANTILES)
    actions = read_columns(meta, (ACTION,))[ACTION].astype(float)
    lost = np.abs(actions - actions.clip(low, high)).mean(axis=0)
    assert lost[0] > 1e-3
    for name, error in zip(["dx", "dy", "dz", "gripper"], lost, strict=True):
        assert shown[name][CLIPPING] == pytest.approx(error, rel=1e-3, abs=1e-7)
        assert shown[name]["cond_mean"] > 0.9 * error


def test_groups_and_coordinates_are_as_asked_for(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    groups = [
        {"dims": [0, 1], "transform": "identity", "bins": [5, 6]},
        {"dims": [2, 3], "transform": "identity", "bins": [7, 8]},
    ]
    flags = f"--policy.action_groups={json.dumps(groups)}", "--policy.grid_distribution=uniform"
    assert fit_grid(root, *flags) == 0
    text = capsys.readouterr().out
    fit = table(text, "Coordinates, theta and phi in radians")
    assert {name: row["bins"] for name, row in fit.items()} == {"dx": 5, "dy": 6, "dz": 7, "gripper": 8}
    assert "dx: -1.0000 -0.6000 -0.2000 0.2000 0.6000 1.0000\n" in text


def test_joints_have_a_token_each(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert fit_grid(root, "--policy.action_layout=joints") == 0
    text = capsys.readouterr().out
    fit = table(text, "Coordinates, theta and phi in radians")
    assert {row["bins"] for row in fit.values()} == {256} and "decoded to no motion" not in text


def test_the_share_of_actions_that_rest_is_shown(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shares = {}
    for length in (None, 0.5):
        assert fit_grid(root, *([] if length is None else [f"--policy.rho_dead={length}"])) == 0
        text = capsys.readouterr().out
        found = re.search(r"dx, dy, dz: ([\d.]+)% of the actions are decoded to no motion", text)
        assert found is not None
        shares[length] = float(found[1]) / 100
    grids, actions, _ = fitted(LeRobotDatasetMetadata(REPO_ID, root=root))
    is_still = grids.encode(torch.from_numpy(actions))[:, 0] == 0
    assert shares[None] == pytest.approx(is_still.float().mean().item(), abs=6e-4)
    assert shares[0.5] > shares[None] + 0.1


def test_the_plot_has_the_edges_where_the_grid_has_them(root: Path, tmp_path: Path) -> None:
    assert fit_grid(root, f"--plot={tmp_path / 'grid.png'}") == 0
    assert [path.name for path in tmp_path.iterdir()] == ["grid.png"]
    plot = np.asarray(Image.open(tmp_path / "grid.png"))
    grids, _, _ = fitted(LeRobotDatasetMetadata(REPO_ID, root=root))
    edges = [row_edges.numpy() for i in range(2) for row_edges in grids.group_edges(i)]
    for row, row_edges in enumerate(edges):
        line = plot[TITLE_HEIGHT + row * ROW_HEIGHT + 10]
        assert np.flatnonzero((line == EDGE_RGB).all(axis=1)).tolist() == sorted(
            {*edge_x(row_edges).tolist()}
        )


def test_bars_of_a_histogram_are_where_the_values_are() -> None:
    values = np.repeat([0.25, 0.75], [100, 25])
    plot = draw_rows("", [PlotRow(["label"], values, np.array([0.0, 0.5, 1.0]))])
    heights = (plot[TITLE_HEIGHT:] == BAR_RGB).all(axis=2).sum(axis=0)
    first, second = (int(edge_x(np.array([0, value, 1]))[1]) for value in (0.25, 0.75))
    assert heights[first - 2 : first + 6].max() == pytest.approx(
        2 * heights[second - 2 : second + 6].max(), abs=2
    )
    assert np.count_nonzero(heights) == 8


# Bad input


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("--dataset.root=nowhere", "--dataset.root=nowhere holds no meta/info.json"),
        (
            "--policy.grid_distribution=cauchy",
            "--policy.grid_distribution='cauchy' is unknown; choose one of",
        ),
        ("--policy.grid_min_sigma=-1", "--policy.grid_min_sigma=-1.0 must be a number of at least 0"),
        (
            "--policy.action_layout=arm",
            "--policy.action_layout='arm' is unknown; choose one of: pose, joints",
        ),
        ("--policy.rho_dead=2", "--policy.rho_dead=2.0 must be in"),
        (
            '--policy.normalization_mapping={"ACTION": "MEAN_STD"}',
            "--policy.normalization_mapping[ACTION]='MEAN_STD' is unknown; choose one of: MIN_MAX",
        ),
        ("--plot=nowhere/grid.png", "--plot=nowhere/grid.png cannot be written"),
    ],
)
def test_bad_flags_are_one_line(
    flag: str, message: str, root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fit_grid(root, flag) == 1
    error = capsys.readouterr().err
    assert error.startswith(f"lerobot-bomb checkpoint fit-grid: {message}")
    assert error.count("\n") == 1


def edited(root: Path, folder: Path, **names: str | None) -> Path:
    """A copy of the dataset whose actions have other statistics under these names, or none."""
    shutil.copytree(root, folder)
    path = folder / "meta" / "stats.json"
    statistics: dict[str, Any] = json.loads(path.read_text())
    before = statistics[ACTION]
    statistics[ACTION] = {
        name: before[names.get(name) or name] for name in before if names.get(name, name) is not None
    }
    path.write_text(json.dumps(statistics))
    return folder


def test_quantiles_are_wanted_only_where_they_are_asked_for(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = edited(root, tmp_path / "old", q01=None, q99=None)
    assert fit_grid(folder) == 0
    assert fit_grid(folder, QUANTILES) == 1
    error = capsys.readouterr().err
    assert "QUANTILES needs the statistics q01, q99, which the dataset lacks" in error
    assert "`lerobot-bomb doctor dataset FOLDER --mend` adds them\n" in error
