"""Figures of explanations: what they draw equals a recount of the effects."""

import base64
import re
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from lerobot_bomb.explain.aggregate import mean_of
from lerobot_bomb.explain.episode import ExplainedMoment
from lerobot_bomb.explain.following import Following
from lerobot_bomb.explain.limits import ALL
from lerobot_bomb.explain.maps import STRENGTH, TINT_RGB
from lerobot_bomb.explain.moment import Explanation, Moved
from lerobot_bomb.explain.patching import OTHER_INSTRUCTION, OTHER_SCENE, PatchingResult
from lerobot_bomb.explain.probes import LayerProbe, Probe
from lerobot_bomb.explain.snapshots import Snapshot
from lerobot_bomb.report.explained_maps import brought_back, heads_section, largest_effect, maps_html
from lerobot_bomb.report.explained_several import aggregate_sections, probes_section
from lerobot_bomb.report.page import render

WORKSPACE, WRIST = "observation.images.workspace", "observation.images.wrist"
SIDE = 8  # pixels of an image
INSTRUCTION = "Place it."


def patched(corruption: str, moved_mm: float, heads: list[list[float]]) -> PatchingResult:
    return PatchingResult(corruption, 0.5, moved_mm, {}, heads, [0.0] * len(heads))


def moment(patch_mm: float, board_mm: float = 10.0, **values: Any) -> ExplainedMoment:
    """A moment in which one patch of each camera, the board and a word matter so far."""
    map_GG = torch.tensor([[patch_mm, 0.0], [0.0, 0.0]])
    maps = {WORKSPACE: map_GG, WRIST: 2 * map_GG}
    objects, words = {ALL: {"board": board_mm}}, {'"Place"': 3.0, '"it"': 0.1, "row": 3.0}
    others = {"row": 8.0}
    explanation = Explanation(
        "nats",
        -1.0,
        maps,
        objects,
        words,
        others,
        values.pop("restored", []),
        Moved(maps, objects, words, others),
    )
    followings = {"row": Following("Place it there.", 90.0, 8.0, values.pop("along_mm", 4.0))}
    snapshot = Snapshot(5, values.pop("phase", "reach"), {}, INSTRUCTION, {}, {}, None, None, {})
    images = {key: np.full((SIDE, SIDE, 3), values.get("grey", 100), np.uint8) for key in maps}
    return ExplainedMoment(snapshot, explanation, [], followings, images, {}, None)


def images_of(html: str) -> list[np.ndarray]:
    """Return the pictures of a page, RGB."""
    sources = re.findall(r"data:image/png;base64,([^\"]+)", html)
    files = [np.frombuffer(base64.b64decode(each), np.uint8) for each in sources]
    return [np.asarray(cv2.imdecode(each, cv2.IMREAD_COLOR_RGB)) for each in files]


def tint(effect: float, largest: float, grey: int) -> list[int]:
    share = STRENGTH * min(effect / largest, 1.0)
    return [round((1 - share) * grey + share * rgb) for rgb in TINT_RGB]


def test_maps_end_where_the_verdict_ends() -> None:
    moments = [moment(2.0), moment(1.0, board_mm=20.0)]
    assert largest_effect(moments) == 20.0
    html = maps_html(moments)
    assert "20.0 mm: how far the next action moves" in html
    assert re.findall(r"at most ([\d.]+ mm)", html) == ["2.0 mm", "4.0 mm", "1.0 mm", "2.0 mm"]
    (first, *_) = images_of(html)
    assert first[0, 0].tolist() == tint(2.0, 20.0, 100) and first[-1, -1].tolist() == [100] * 3
    assert f"{round(STRENGTH * (3 / 20), 3)})" in html  # the word "Place"


def test_heads_are_drawn_in_the_scale_of_the_maps() -> None:
    strong = patched(f"{OTHER_INSTRUCTION}: 'x'", 8.0, [[0.0, 0.25], [1.5, np.nan]])
    assert brought_back(strong).tolist() == [[0.0, 2.0, 0.0], [8.0, 0.0, 0.0]]
    weak = patched(OTHER_SCENE, 0.5, [[1.0, 0.0], [0.0, 0.0]])
    section = heads_section([moment(2.0, restored=[strong, weak])])
    assert section is not None
    (chart,) = section.charts
    assert "take away: other scene." in chart.note and "other words" in chart.svg and "8.0 mm" in chart.svg
    assert "other scene" not in chart.svg
    nothing = heads_section([moment(2.0, restored=[weak])])
    assert nothing is not None and not nothing.charts
    assert "No single head or MLP brings back what these changes take away: other scene." in nothing.figures
    assert heads_section([moment(2.0)]) is None


def several() -> dict[str, list[ExplainedMoment]]:
    reach = [moment(2.0, along_mm=4.0, grey=100), moment(6.0, along_mm=8.0, grey=140)]
    return {"reach": reach, "carry": [moment(1.0, board_mm=30.0, phase="carry")]}


def test_mean_maps_are_of_the_camera_that_stands_still() -> None:
    sections = {each.title: each for each in aggregate_sections(["Fine."], several(), "command")}
    html = sections["Where in the image"].figures
    assert re.findall(r"<figcaption>([^<]*)", html) == ["reach, 2 episodes", "carry, 1 episodes"]
    assert re.findall(r"at most ([\d.]+ mm)", html) == ["4.0 mm", "1.0 mm"]
    assert "30.0 mm: how far" in html and "The camera stands still" in html and "wrist" not in html
    first, second = images_of(html)
    assert first[0, 0].tolist() == tint(4.0, 30.0, 120) and first[-1, -1].tolist() == [120] * 3
    assert second[0, 0].tolist() == tint(1.0, 30.0, 100)


def test_the_figure_of_followed_words_has_their_means() -> None:
    sections = {each.title: each for each in aggregate_sections(["Fine."], several(), "command")}
    effects, following = sections["Effects"].charts
    (table,) = following.tables
    told = [[cell.text if cell.value is None else cell.value["value"] for cell in row] for row in table.rows]
    assert told == [["reach", "row", 90.0, 8.0, 6.0], ["carry", "row", 90.0, 8.0, 4.0]]
    mean = mean_of([4.0, 8.0])
    assert mean is not None and table.rows[0][-1].value["interval"] == mean.interval
    assert following.svg.count("another row") == 2 and "board" in effects.svg
    assert "<script" not in render("Several", [*sections.values()])


@pytest.mark.parametrize("places", [("answer",), ("instruction", "answer")])
def test_probes_are_drawn_layer_by_layer(places: tuple[str, ...]) -> None:
    probes = [
        LayerProbe("target's row", place, layer, Probe(0.5, 0.2, 3, 1))
        for place in places
        for layer in (0, 1)
    ]
    (chart,) = probes_section(probes).charts
    assert [row[1].text for row in chart.tables[0].rows] == [
        f"{place}, layer {layer}" for place in places for layer in (0, 1)
    ]
    assert all(place in chart.svg for place in places)
