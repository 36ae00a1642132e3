"""Parts of explanations: spans, masks, probes, means, findings."""

import math
import re
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from explain_cases import NAMES, SPEC, loaded, moment
from matplotlib.figure import Figure

from lerobot_bomb.bomb.board import BOARD, HALVES
from lerobot_bomb.explain.aggregate import mean_of, means_of
from lerobot_bomb.explain.counterfactuals import conditions_without
from lerobot_bomb.explain.diagnosis import used
from lerobot_bomb.explain.film import EpisodeRun
from lerobot_bomb.explain.images import filling, occluded, patch_masks
from lerobot_bomb.explain.maps import tinted
from lerobot_bomb.explain.moment import Explanation
from lerobot_bomb.explain.probes import probe_classes, probe_values
from lerobot_bomb.explain.spans import difference, named_spans, span_of, spans_of_words, token_offsets
from lerobot_bomb.report import explained_film
from lerobot_bomb.report.explained_film import paths_chart

pytestmark = pytest.mark.usefixtures("loaded_policies")

TEXT = "Put a black stone at position (1, 1) on the Go board."


def words(text: str, ranges: tuple[tuple[int, int], ...]) -> list[str]:
    return [text[start:end] for start, end in ranges]


def test_a_span_is_found_everywhere_but_not_within_other_words() -> None:
    assert words(TEXT, span_of("1", TEXT).ranges) == ["1", "1"]
    assert words("row 12, row 2", span_of("2", "row 12, row 2").ranges) == ["2"]
    assert words(TEXT, span_of("black STONE", TEXT).ranges) == ["black stone"]
    assert words(TEXT, span_of("(1, 1)", TEXT).ranges) == ["(1, 1)"]
    with pytest.raises(ValueError, match="'white' are not in the instruction"):
        span_of("white", TEXT)
    with pytest.raises(ValueError, match="'' are not in the instruction"):
        span_of("", TEXT)


def test_a_difference_is_of_the_word_that_another_instruction_changes() -> None:
    column = difference("column", TEXT, TEXT.replace("(1, 1)", "(1, 3)"))
    assert column is not None and column.ranges == ((TEXT.index("1)"), TEXT.index("1)") + 1),)
    assert difference("none", TEXT, TEXT) is None
    assert difference("longer", TEXT, f"Please {TEXT}") is None


def test_row_and_column_are_also_hidden_together() -> None:
    others = {
        "row": TEXT.replace("(1,", "(3,"),
        "column": TEXT.replace("1)", "3)"),
        "color": TEXT.replace("black", "white"),
    }
    spans = {span.name: words(TEXT, span.ranges) for span in named_spans(TEXT, others)}
    assert spans == {"row": ["1"], "column": ["1"], "color": ["black"], "row and column": ["1", "1"]}


def test_words_that_stand_there_twice_have_names_of_their_own() -> None:
    assert [span.name for span in spans_of_words("1, 1 and 1")] == ["1", "1 (2)", "and", "1 (3)"]


@pytest.mark.parametrize("name", NAMES)
def test_tokens_of_a_span_spell_it(name: str) -> None:
    steps = loaded(name).prepare.steps
    step: Any
    (step,) = (step for step in steps if hasattr(step, "template"))
    instruction = moment()[1]
    ids = loaded(name).prepare(loaded(name).observe([moment()[0]], [instruction]))
    (tokens,) = ids["observation.language.tokens"]
    offsets = token_offsets(steps, instruction)
    assert len(offsets) == len(tokens)
    for span in spans_of_words(instruction):
        chosen = tokens[span.tokens(offsets)].tolist()
        assert instruction[slice(*span.ranges[0])].lower() in step.tokenizer.decode(chosen).lower()


def test_a_grid_covers_every_pixel_once() -> None:
    masks = patch_masks(4, 8, 12)
    assert masks.shape == (16, 8, 12) and masks.sum(dim=0).eq(1).all()
    assert masks[5].nonzero().min(dim=0).values.tolist() == [2, 3]
    with pytest.raises(ValueError, match=r"--grid=5 does not divide an image of 8 x 12 pixels"):
        patch_masks(5, 8, 12)


def test_fillings() -> None:
    image = torch.rand(3, 16, 16)
    assert filling(image, "mean", 1.0)[:, 0, 0].tolist() == pytest.approx(image.mean(dim=(1, 2)).tolist())
    blurred = filling(image, "blur", 2.0)
    assert blurred.shape == image.shape and blurred.std() < image.std() / 2
    other = torch.rand(3, 16, 16)
    assert filling(image, "other", 1.0, other) is other
    with pytest.raises(ValueError, match="--fill=other needs an image of another episode"):
        filling(image, "other", 1.0)
    with pytest.raises(ValueError, match="--fill"):
        filling(image, "black", 1.0)
    mask = torch.zeros(1, 16, 16, dtype=torch.bool)
    mask[0, 3, 4] = True
    (changed,) = occluded(image, mask, other)
    assert (changed != image).any(dim=0).nonzero().tolist() == [[3, 4]]


def test_a_probe_finds_what_is_there_and_nothing_in_noise() -> None:
    rng = np.random.default_rng(0)
    labels = rng.integers(5, size=200)
    features = rng.standard_normal((200, 64)) + 3 * rng.standard_normal((5, 64))[labels]
    found = probe_classes(features, labels)
    assert found.score == 1 and 0.05 < found.floor < 0.4 and found.num_held_out == 60
    noise = probe_classes(rng.standard_normal((200, 64)), labels)
    assert abs(noise.score - noise.floor) < 0.2
    places = rng.standard_normal((200, 2))
    known = probe_values(
        places @ rng.standard_normal((2, 64)) + 0.01 * rng.standard_normal((200, 64)), places
    )
    assert known.score > 0.9 > 0.1 > known.floor
    with pytest.raises(ValueError, match="--episodes=10"):
        probe_classes(features[:9], labels[:9])


def test_means_are_of_what_is_known() -> None:
    assert mean_of([math.nan]) is None
    alone = mean_of([2.0])
    assert alone is not None and alone.value == 2 and alone.interval is None
    mean = means_of([{"a": 1.0, "b": 2.0}, {"a": 3.0}, {"a": math.nan}])["a"]
    assert mean.value == 2 and mean.num_episodes == 2
    assert mean.interval is not None and mean.interval[0] <= 2 <= mean.interval[1]


def test_effects_that_are_rounding_or_small_beside_the_largest_are_none() -> None:
    assert used({"a": 1.0, "b": -0.5, "c": 0.04, "d": 0.0}, -10.0) == {"a": 1.0, "b": -0.5}
    assert used({"a": 1e-6, "b": 0.0}, -10.0) == {}
    assert used({}, -10.0) == {}


def test_json_has_nothing_that_is_no_number() -> None:
    explanation = Explanation(
        "nats", -1.0, {"image": torch.tensor([[math.nan]])}, {}, {"a": math.nan}, {}, []
    )
    assert explanation.as_json()["patches"] == {"image": [[None]]}
    assert explanation.as_json()["words"] == {"a": None}


def test_every_pixel_shows_one_thing() -> None:
    for masks in moment()[2].values():
        whole = [mask for name, mask in masks.items() if name not in HALVES]
        assert np.sum(whole, axis=0).tolist() == np.ones((64, 64)).tolist()
        for two in (HALVES[:2], HALVES[2:]):
            assert np.array_equal(masks[two[0]] ^ masks[two[1]], masks["board"])


def test_halves_of_the_board_hold_its_outer_lines() -> None:
    corners = np.array([BOARD.intersection_xy(row, column) for row in (0, 4) for column in (0, 4)])
    assert {name: half.tolist() for name, half in BOARD.halves(corners).items()} == {
        "board's left half": [True, False, True, False],
        "board's right half": [False, True, False, True],
        "board's far half": [True, True, False, False],
        "board's near half": [False, False, True, True],
    }


def test_halves_in_the_image_are_where_the_camera_sees_them() -> None:
    masks = moment()[2]["workspace"]
    left, right, far, near = (np.argwhere(masks[name]).mean(axis=0) for name in HALVES)
    assert left[1] < right[1] and far[0] < near[0]  # this camera looks from the near side


def test_masks_show_stone_gripper_and_target_in_both_cameras() -> None:
    workspace, wrist = moment()[2]["workspace"], moment()[2]["wrist"]
    for name in ("stone", "target", "gripper", "board"):
        assert workspace[name].any(), name
    assert wrist["stone"].any() and wrist["gripper"].any()
    # the target is a disc around the intersection, not the board
    assert 0 < workspace["target"].sum() < workspace["board"].sum() / 5


def test_other_instructions_differ_in_one_word_and_name_their_intersection() -> None:
    instruction, others = moment()[1], moment()[3]
    row, column = SPEC.target or (0, 0)
    assert set(others) == {"row", "column", "color"}
    for word, (other, intersection) in others.items():
        span = difference(word, instruction, other)
        assert span is not None and len(span.ranges) == 1
        expected = {
            "row": ((row + 2) % BOARD.num_lines, column),
            "column": (row, (column + 2) % BOARD.num_lines),
        }
        assert intersection == expected.get(word, (row, column))


def test_every_path_has_a_look_of_its_own_and_the_numbers_are_in_a_table() -> None:
    ended = cast("Any", SimpleNamespace(is_success=False, failure="dropped"))
    runs = {
        f"mask {number}": EpisodeRun(ended, np.full((3, 3), 0.01 * number), np.full((3, 3), 0.02), None)
        for number in range(20)
    }
    chart = paths_chart("Paths", runs, (0.0, 0.045))
    looks = set(re.findall(r'style="fill: none; stroke[^"]*"', chart.svg))
    assert len(looks) > 20 and all(name in chart.svg for name in runs)
    (table,) = chart.tables
    assert [cell.value or cell.text for cell in table.rows[1]] == ["mask 1", "failed, dropped", "2", 20, 20]


def test_a_stone_that_ended_far_off_the_board_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    figure = Figure()
    monkeypatch.setattr(explained_film, "draw", lambda title, size, paint: paint(figure) or "")
    ended = cast("Any", SimpleNamespace(is_success=False, failure="dropped"))
    stone_xy = np.array([0.4, -0.5])
    paths_chart("Paths", {"it": EpisodeRun(ended, np.zeros((3, 3)), stone_xy[None], None)}, None)
    (low_x, high_x), (low_y, high_y) = figure.axes[0].get_xlim(), figure.axes[0].get_ylim()
    assert low_x < stone_xy[0] < high_x and low_y < stone_xy[1] < high_y


def test_conditions_without_an_axis_keep_the_levels_that_were_drawn() -> None:
    assert [*conditions_without({"camera": 2, "light": 0, "object": 4})] == [
        (("camera",), "object:4"),
        (("object",), "camera:2"),
        (("camera", "object"), "none"),
    ]
    assert [*conditions_without({"camera": 2})] == [(("camera",), "none")]
    assert [*conditions_without({"camera": 0})] == []


def test_a_map_tints_an_image_where_the_effect_is() -> None:
    image = np.full((4, 4, 3), 100, np.uint8)
    shown = tinted(np.array([[0.0, 2.0], [-1.0, 1.0]]), 2.0, image)
    assert shown[0, 0].tolist() == shown[3, 0].tolist() == [100, 100, 100]
    assert shown[0, 3].tolist() == [185, 96, 25] and shown[3, 3].tolist() == [142, 98, 62]
    assert tinted(np.zeros((2, 2)), 0.0, image).tolist() == image.tolist()
