"""Success rates on a card, in a sentence, in a figure and in the metadata."""

import json
import re
from typing import Any
from xml.etree import ElementTree

import pytest
from bomb_pusht_cases import pusht_row
from result_rows import read, values

from lerobot_bomb.hub.evaluations import model_index
from lerobot_bomb.hub.rates import headline, mostly_failing, rates_chart, rates_of
from lerobot_bomb.report.chart import standalone
from lerobot_bomb.report.report import Report
from lerobot_bomb.report.sections import answer
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


def test_the_headline_of_equal_rates() -> None:
    tied = headline(group(none=(9, 10), camera_3=(2, 10), light_3=(2, 10)))
    assert "under `camera:3`, none lower in 2 conditions (" in tied


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


def dots(svg: str) -> list[tuple[float, float]]:
    """(x, y) of the marks of the first column, from the top down."""
    first = svg[svg.index("success, per cent") : svg.index("change, percentage points")]
    found = re.findall(
        r'<use href="#\w+" x="([\d.]+)" y="([\d.]+)" style="fill: #0072b2; stroke: #0072b2"', first
    )
    return sorted(((float(x), float(y)) for x, y in found), key=lambda xy: xy[1])


def test_the_figure_has_a_dot_where_each_rate_is() -> None:
    svg = rates_chart([group(none=(10, 10), light_3=(5, 10), camera_3=(0, 10))]).svg
    (all_of_them, _), (none, _), (half, _) = dots(svg)
    assert none < half < all_of_them and half - none == pytest.approx(all_of_them - half, abs=0.1)
    names = [svg.index(f">{name}<") for name in ("unperturbed", "camera:3", "light:3")]
    assert names == sorted(names)


def test_the_figure_of_a_card_is_that_of_a_report() -> None:
    groups = [group(none=(9, 10), camera_3=(2, 10))]
    (chart,) = answer.section(Report(groups)).charts
    assert rates_chart(groups) == chart
    assert ElementTree.fromstring(standalone(chart.svg)).tag == "{http://www.w3.org/2000/svg}svg"


def test_the_metadata_has_a_name_without_numbers_and_the_counts_beside_it() -> None:
    (result,) = model_index([group(none=(9, 10))])
    assert (result.metric_name, result.metric_value) == ("success rate", 0.9)
    assert result.metric_args == {
        "successes": 9,
        "episodes": 10,
        "interval": [0.5958, 0.9821],
        "method": "95 % Wilson interval",
    }
