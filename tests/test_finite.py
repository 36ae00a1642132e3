"""Numbers that are NaN or infinite are named where they are; policies are in test_finite_policies.py."""

import math
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from lerobot_bomb.actions.bins import BIN_MODES, Bins
from lerobot_bomb.actions.grid_settings import GridSettings, default_groups
from lerobot_bomb.actions.grids import ActionGrids
from lerobot_bomb.checkpoints.checks import check_finite
from lerobot_bomb.finite import (
    is_finite,
    require_finite,
    require_finite_answers,
    require_finite_batch,
    require_finite_rows,
    require_finite_statistics,
    require_finite_weights,
)

TYPES = [torch.float64, torch.float32, torch.bfloat16, torch.float16, torch.float8_e4m3fn]


@pytest.mark.parametrize("dtype", TYPES)
def test_every_kind_of_float_is_looked_at(dtype: torch.dtype) -> None:
    values = torch.ones(3, 5)
    assert is_finite(values.to(dtype))
    values[1, 2] = torch.nan
    assert not is_finite(values.to(dtype))


def test_large_numbers_are_finite_though_their_sum_is_not() -> None:
    assert is_finite(torch.full((4,), 3e38))
    assert is_finite(torch.tensor([6e4, 6e4, -6e4, -6e4], dtype=torch.float16))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_infinities_that_cancel_are_found(bad: float) -> None:
    with pytest.raises(ValueError, match=r"^x is not finite: 2 of 4 .*, the first at \[0, 1\]$"):
        require_finite(torch.tensor([[1, bad], [-bad, 1]]), "x")


def test_integers_and_nothing_are_finite() -> None:
    require_finite(torch.zeros(0), "x")
    require_finite(torch.tensor([2**62, 2**62]), "x")
    require_finite(torch.tensor(True), "x")


# Files


def save(folder: Path, **tensors: Tensor) -> Path:
    save_file(tensors, folder / "x.safetensors")
    return folder / "x.safetensors"


@pytest.mark.parametrize("dtype", TYPES)
def test_a_file_names_its_tensor(tmp_path: Path, dtype: torch.dtype) -> None:
    bad = torch.ones(2, 3)
    bad[1, 0] = torch.nan
    check_finite(save(tmp_path, good=torch.ones(2).to(dtype), text=torch.ones(4, dtype=torch.uint8)))
    path = save(tmp_path, good=torch.ones(2).to(dtype), bad=bad.to(dtype))
    with pytest.raises(ValueError, match=r"x\.safetensors: bad is not finite: 1 of 6 .* at \[1, 0\]"):
        check_finite(path)


EDGES = [[0, 1, 2, 3], [0, 1, 2, math.inf], [0, 1, math.inf, math.inf]]


def test_a_grid_is_filled_with_inf(tmp_path: Path) -> None:
    check_finite(save(tmp_path, **{"grids.edges": torch.tensor(EDGES)}))
    with pytest.raises(ValueError, match=r"other is not finite"):
        check_finite(save(tmp_path, other=torch.tensor(EDGES)))


@pytest.mark.parametrize(("row", "column", "bad"), [(0, 2, math.inf), (2, 1, math.inf), (1, 3, math.nan)])
def test_what_is_no_filling_of_a_grid_is_found(tmp_path: Path, row: int, column: int, bad: float) -> None:
    edges = torch.tensor(EDGES)
    edges[row, column] = bad
    path = save(tmp_path, **{"grids.edges": edges})
    with pytest.raises(ValueError, match=rf"edges is not finite: 1 of 12 .* at \[{row}, {column}\]"):
        check_finite(path)


def test_a_models_weights_are_named() -> None:
    model = nn.Linear(2, 2)
    require_finite_weights(model, "--flag=x")
    nn.init.constant_(model.bias, torch.inf)
    with pytest.raises(ValueError, match=r"^--flag=x: bias is not finite: 2 of 2"):
        require_finite_weights(model, "--flag=x")


# Batches and datasets


def test_an_action_is_found_in_the_frame_that_it_belongs_to() -> None:
    actions = torch.zeros(3, 4, 2)
    actions[1, 2, 1] = torch.nan
    frames = {"episode_index": torch.tensor([7, 8, 9]), "index": torch.tensor([70, 81, 92])}
    with pytest.raises(ValueError, match=r"'action' .* frame 83 of the dataset .* episode 8, row 1 of"):
        require_finite_batch({"action": actions}, frames)
    with pytest.raises(ValueError, match=r"^'action' is not finite in row 1 of the batch: 1 of 8 values"):
        require_finite_batch({"action": actions}, {})


def test_a_state_is_found_among_other_keys() -> None:
    values = {"a": torch.zeros(2, 3), "b": torch.zeros(2, 3), "c": torch.zeros(2, 9, dtype=torch.uint8)}
    frames = {"episode_index": torch.tensor(3), "index": torch.tensor(12)}  # of one frame, as a user gives it
    require_finite_batch(values, frames)
    require_finite_batch({**values, "b": torch.full((2, 3), 3e38)}, frames)
    values["b"][0, 2] = torch.inf
    with pytest.raises(ValueError, match=r"'b' .* frame 12 .* of episode 3, .* the first at \[2\]"):
        require_finite_batch(values, frames)


def test_rows_are_counted_not_values() -> None:
    rows = torch.zeros(5, 3)
    rows[[1, 3]] = torch.nan
    with pytest.raises(ValueError, match=r"^no grid: 2 of 5 actions are not finite, the first at index 1: "):
        require_finite_rows(rows, "no grid", "actions")


def test_rows_of_answers_have_their_numbers() -> None:
    finite = torch.tensor([True, False, True, False])
    with pytest.raises(ValueError, match=r"the rows \[1, 3\] of the batch"):
        require_finite_answers(finite)
    with pytest.raises(ValueError, match=r"the rows \[5, 9\] of the batch"):
        require_finite_answers(finite, torch.tensor([4, 5, 7, 9]))
    require_finite_answers(finite[::2])


def test_statistics_that_nothing_is_normalised_by_are_left_alone() -> None:
    bad = {"mean": [0.0, math.nan]}
    require_finite_statistics({"action": {"mean": [0.0]}, "next.reward": bad})
    require_finite_statistics(None)
    with pytest.raises(ValueError, match=r"stats\.json\): mean of 'observation.state' is not finite: 1 of 2"):
        require_finite_statistics({"observation.state": bad})


# Codes of actions


@pytest.mark.parametrize("mode", BIN_MODES)
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_no_bin_is_of_what_is_not_finite(mode: str, bad: float) -> None:
    with pytest.raises(ValueError, match="written as a number is not finite: 1 of 2"):
        Bins(101, mode).encode(torch.tensor([0.0, bad]))


def grids() -> ActionGrids:
    return ActionGrids(GridSettings(default_groups(4)), 4)


def test_no_cell_is_of_what_is_not_finite() -> None:
    with pytest.raises(ValueError, match=r"put into a grid is not finite: 1 of 8 .* at \[1, 3\]"):
        grids().encode(torch.tensor([[0.0, 0, 0, 0], [0, 0, 0, math.nan]]))


@pytest.mark.parametrize(
    ("key", "message"),
    [("means", "coordinate 0 of the grid"), ("gaussians", "coordinate 0"), ("rest", "no motion")],
)
def test_a_checkpoints_grid_is_finite(key: str, message: str) -> None:
    parameters = grids().to_dict()
    values = parameters[key][0] if isinstance(parameters[key][0], list) else parameters[key]
    values[0] = math.nan
    with pytest.raises(ValueError, match=f"{message}.* is not finite"):
        ActionGrids.from_dict(parameters, 4)
