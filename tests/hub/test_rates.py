"""Success rates on a card, in a sentence, in a figure and in the metadata."""

import io
import json
from typing import Any

import numpy as np
import pytest
from bomb_pusht_cases import pusht_row
from PIL import Image
from result_rows import read, values

from lerobot_bomb.hub.evaluations import model_index
from lerobot_bomb.hub.rates import MAX_ROWS, figure, headline, mostly_failing, rates_of
from lerobot_bomb.results.groups import Group, groups_of
from lerobot_bomb.results.reading import parse_record


def group(**successes: tuple[int, int]) -> Group:
    """Return episodes of conditions, written as `camera_3=(successes, episodes)`."""
    records = [
        read(values(seed, None if seed < good else "dropped", spec={"perturbations": name.replace("_", ":")}))
        for name, (good, number) in successes.items()
        for seed in range(number)
    ]
    (found,) = groups_of(records)
    return found


def test_the_headline_names_the_unperturbed_rate_and_the_lowest() -> None:
    assert headline(group(none=(9, 10), camera_3=(2, 10), light_1=(5, 10))) == (
        "BOMB, task version 1.0, place: **9/10 = 90.0 % [59.6, 98.2]** unperturbed; 2/10 = 20.0 % "
        "[5.7, 51.0] under `camera:3`, the lowest of 2 conditions (95 % Wilson interval)."
    )


def test_the_headline_of_few_episodes_and_of_one_arm() -> None:
    one = headline(group(none=(1, 1)))
    assert one == (
        "BOMB, task version 1.0, place: **1/1 = 100.0 % [20.7, 100.0]** unperturbed (95 % Wilson interval)."
    )
    assert headline(group(camera_3=(0, 1))).startswith(
        "BOMB, task version 1.0, place: 0/1 = 0.0 % [0.0, 79.3] under `camera:3` ("
    )


def test_an_environment_without_suites() -> None:
    row: dict[str, Any] = pusht_row(7, "none", 0.5, "timeout")
    (pusht,) = groups_of([parse_record(json.dumps(row).encode())])
    assert headline(pusht).startswith("PushT with BOMB's axes, protocol pusht-1.0, ")


def test_rates_are_sorted_by_loss_and_counted_from_the_records() -> None:
    found = rates_of(group(camera_3=(2, 4), none=(1, 4), light_3=(1, 4)))
    assert {name: (rate.successes, rate.n) for name, rate in found.items()} == {
        "none": (1, 4),
        "light:3": (1, 4),
        "camera:3": (2, 4),
    }
    assert list(found) == ["none", "light:3", "camera:3"]


def test_conditions_that_mostly_fail() -> None:
    assert mostly_failing([group(none=(2, 4), camera_3=(1, 4))]) == ["`camera:3` (1/4)"]


def test_the_figure_has_a_dot_where_the_rate_is() -> None:
    pixels = np.asarray(
        Image.open(io.BytesIO(figure([group(none=(10, 10), camera_3=(0, 10))]))).convert("RGB")
    )
    blue = np.argwhere((pixels == (0, 114, 178)).all(axis=2))
    rows, columns = blue.T
    upper, lower = (columns[mask] for mask in (rows < np.median(rows), rows > np.median(rows)))
    assert upper.min() > lower.max()  # 10 of 10 at the right, above 0 of 10 at the left


@pytest.mark.parametrize("number", [1, MAX_ROWS, MAX_ROWS + 5])
def test_the_figure_grows_with_the_conditions_up_to_a_number(number: int) -> None:
    names = [f"camera:{1 + i % 5}+light:{1 + i // 5 % 5}+start:{1 + i // 25}" for i in range(number)]
    records = [read(values(0, spec={"perturbations": name})) for name in names]
    image = Image.open(io.BytesIO(figure(groups_of(records))))
    assert image.size[1] == pytest.approx(150 * (0.24 * (min(number, MAX_ROWS) + 3) + 0.3), abs=2)


def test_the_metadata_has_a_name_without_numbers_and_the_counts_beside_it() -> None:
    (result,) = model_index([group(none=(9, 10))])
    assert (result.metric_name, result.metric_value) == ("success rate", 0.9)
    assert result.metric_args == {
        "successes": 9,
        "episodes": 10,
        "interval": [0.5958, 0.9821],
        "method": "95 % Wilson interval",
    }
