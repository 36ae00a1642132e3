"""Verdict of an explanation: sentences from the values of `explanation.json`."""

from typing import Any

import pytest

from lerobot_bomb.explain.facts import outcome
from lerobot_bomb.explain.verdict import reasons, verdict

GRID = [[0.0, 0.0], [0.0, 0.0]]


def moment(phase: str = "reach", **values: Any) -> dict[str, Any]:
    """Effects of a moment; ``mm``: in millimetres."""
    effects = {"patches": {"observation.images.wrist": GRID}, "objects": {}, "words": {}, "others": {}}
    mm = values.pop("mm", None)
    given = {"phase": phase, "unit": "nats", "clean_score": -2.0, "restored": [], "following": {}}
    return effects | given | {"moved_mm": None if mm is None else effects | mm} | values


def seen(**objects: float) -> dict[str, Any]:
    return {"objects": {"all cameras": objects}}


def result(failure: str | None = None, **values: Any) -> dict[str, Any]:
    return {
        "is_success": failure is None,
        "failure": failure,
        "steps": 24,
        "placement_error_mm": 43.04,
        "target": [4, 2],
        "nearest_intersection": [3, 2],
        "collateral_mm": 0.1,
    } | values


# Objects, patches, words


def test_one_that_never_looked_at_the_stone() -> None:
    words = {"row": 12.0, "column": 9.0, "row and column": 18.5, "color": 0.2, '"Place"': 3.0}
    moments = [
        moment("reach", mm=seen(stone=0.3, board=14.0, gripper=0.1)),
        moment("carry", mm=seen(stone=0.2, board=2.0, gripper=6.0) | {"words": words}),
    ]
    assert reasons(moments) == [
        "In the 2 steps examined, it never looked at the stone: hiding it changes the next action by at most "
        "0.3 mm, hiding the board by 14.0 mm at reach.",
        "It looks at the board (14.0 mm at reach) and the gripper (6.0 mm at carry): so much the next action "
        "moves when that is hidden.",
        "Of the instruction, the word for row (12.0 mm at carry) and the word for column (9.0 mm at carry) "
        "decide; the word for colour does not.",
    ]


def test_a_half_of_the_board_that_matters_most_is_named() -> None:
    objects = {"stone": 0.3, "board": 9.0, "board's left half": 14.0, "board's far half": 12.0}
    assert reasons([moment("reach", mm=seen(**objects))])[:2] == [
        "In the one step examined, it never looked at the stone: hiding it changes the next action by at "
        "most 0.3 mm, hiding the board's left half by 14.0 mm at reach.",
        "It looks at the board's left half (14.0 mm at reach): so much the next action moves when that is "
        "hidden.",
    ]
    as_much = reasons([moment("reach", mm=seen(**objects | {"board": 14.0}))])
    assert as_much[1].startswith("It looks at the board's left half (14.0 mm")
    weaker = seen(**objects | {"board": 15.0})
    assert "half" not in " ".join(reasons([moment("reach", mm=weaker)]))


def test_one_that_looks_at_nothing_and_reads_nothing() -> None:
    values = seen(stone=0.1, board=0.3) | {"words": {"row": 0.0}, "others": {"row": 0.04}}
    assert reasons([moment(mm=values)]) == [
        "It looks at nothing in its images: hiding any one thing changes the next action by at most 0.3 mm.",
        "It does not read the instruction: hiding or changing any of its words changes the next action by at "
        "most 0.0 mm.",
    ]
    assert reasons([moment()])[-1] == "It reads no instruction."


def test_a_changed_word_counts_as_much_as_a_hidden_one() -> None:
    words = {"row": 0.4, "column": 5.0, "row and column": 5.6}
    (_, told) = reasons([moment("carry", mm={"words": words, "others": {"row": 25.0, "column": 9.0}})])
    assert told == (
        "Of the instruction, the word for row (25.0 mm at carry) and the word for column (9.0 mm at carry) "
        "decide."
    )
    (_, told) = reasons([moment("carry", mm={"words": words | {"row": 0.0, "color": 0.3}})])
    assert told == (
        "Of the instruction, only the word for column (5.0 mm at carry) decides; the word for colour and the "
        "word for row do not."
    )


def test_without_millimetres_it_speaks_of_the_score() -> None:
    patches = {"observation.images.wrist": [[0.0, 3.5], [1e-5, 0.1]]}
    assert reasons([moment("grasp", patches=patches, words={"column": -0.02, "row": 1e-6})]) == [
        "Of all image patches, only wrist patch 0, 1 matters (3.5 nats at grasp).",
        "Of the instruction, only the word for column (0.02 nats at grasp) decides, though weakly beside "
        "what it sees; the word for row does not.",
    ]
    assert reasons([moment("grasp", patches={"wrist": [[2.0, 3.5], [1e-5, 0.1]]})])[0] == (
        "2 of 4 image patches matter, most of all wrist patch 0, 1 (3.5 nats at grasp)."
    )


def test_words_of_a_suite_without_rows_are_named() -> None:
    words = {'"between"': 5.3, '"white"': 4.0, '"the"': 0.02}
    assert reasons([moment("carry", words=words)])[-1] == (
        'Of the instruction, the word "between" (5.3 nats at carry) and the word "white" (4 nats at carry) '
        "decide; no other word does."
    )


def test_how_far_it_follows_another_target_is_told() -> None:
    following = {"row": {"along_mm": 31.68}, "column": {"along_mm": 0.4}, "color": {"along_mm": None}}
    assert reasons([moment("carry", following=following)])[-1] == (
        "Told of another place, the next action moves towards it: 31.7 mm at carry for another row."
    )


@pytest.mark.parametrize(
    ("heads", "told"),
    [
        (
            [[0.0, 0.1], [0.98, None]],
            "One head alone carries the instruction at carry: layer 1, head 0 (98%) of ",
        ),
        (
            [[0.6, 0.1], [0.98, 0.0]],
            "2 heads each carry the instruction at carry: layer 1, head 0 (98%) and ",
        ),
    ],
)
def test_heads_that_carry_the_instruction_are_named(heads: list[list[float | None]], told: str) -> None:
    restored = [
        {"corruption": "wrist patch 1, 2 taken out", "drop": 9.0, "heads": [[1.0, 1.0], [1.0, 1.0]]},
        {"corruption": "other instruction: 'Place it.'", "drop": 0.4, "heads": heads},
    ]
    restored = [{"moved_mm": None, **each} for each in restored]
    assert reasons([moment("carry", restored=restored)])[-1].startswith(told)
    for weak in ({"drop": 1e-5}, {"moved_mm": 0.9}):
        sentences = reasons([moment("carry", restored=[restored[1] | weak])])
        assert sentences[-1] == "It reads no instruction."


def test_pointing_tells_misreading_from_not_acting() -> None:
    right = {"place": "row 1, column 3", "meant_place": "row 1, column 3", "goes_there": True}
    moments = [moment("reach", pointing=right), moment("carry", pointing=right | {"goes_there": False})]
    assert reasons(moments)[-1] == (
        "It points at the place that is meant, but its next action does not go there, in 1 of 2 moments "
        "(at carry)."
    )
    assert reasons(moments[:1])[-1] == (
        "It points at the place that is meant, and its next action goes there."
    )
    wrong = moment("carry", pointing=right | {"place": "row 2, column 3"})
    assert reasons([moments[0], wrong])[-1] == (
        "It misreads the place in 1 of 2 moments: it points at row 2, column 3, not row 1, column 3 "
        "(at carry)."
    )


# Endings


@pytest.mark.parametrize(
    ("values", "told"),
    [
        (
            result(placement_error_mm=0.11),
            "It succeeded after 24 steps: the stone is 0.1 mm from row 4, column 2.",
        ),
        (
            result("missed_grasp", collateral_mm=55.6),
            "It failed (missed_grasp) after 24 steps: it came to the stone, but never lifted it; the stone "
            "is 43.0 mm from row 4, column 2; another stone was moved 55.6 mm (10 mm are allowed).",
        ),
        (
            result("dropped", target=None),
            "It failed (dropped) after 24 steps: it lifted the stone and let it fall; the stone is 43.0 mm "
            "from its target.",
        ),
        (
            result("wrong_intersection"),
            "It failed (wrong_intersection) after 24 steps: it put the stone down in the wrong place; the "
            "stone is 43.0 mm from row 4, column 2, nearest to row 3, column 2.",
        ),
        ({"is_success": False, "failure": "timeout"}, "It failed (timeout)."),
    ],
)
def test_an_outcome_says_what_the_record_knows(values: dict[str, Any], told: str) -> None:
    assert outcome(values) == told


def without(axes: list[str], left: str, failure: str | None) -> dict[str, Any]:
    return {"without": axes, "perturbations": left, "result": result(failure, steps=23)}


BOTH_FAIL = [without(["camera"], "object:3", "dropped"), without(["object"], "camera:3", "dropped")]


@pytest.mark.parametrize(
    ("counterfactuals", "told"),
    [
        (
            [without(["object"], "none", None)],
            'The same seed succeeds without axis "object" (in 23 steps).',
        ),
        (
            [without(["object"], "none", "dropped")],
            "The perturbations are not the reason: the same seed unperturbed fails too (dropped).",
        ),
        (
            [
                BOTH_FAIL[0],
                without(["object"], "camera:3", None),
                without(["camera", "object"], "none", None),
            ],
            'The same seed succeeds without axis "object" (in 23 steps); leaving out any other does not '
            "help.",
        ),
        (
            [*BOTH_FAIL, without(["camera", "object"], "none", None)],
            "The same seed succeeds unperturbed (in 23 steps), but without any single perturbation it "
            "fails too: they break it together.",
        ),
    ],
)
def test_a_counterfactual_settles_it(counterfactuals: list[dict[str, Any]], told: str) -> None:
    episode = {"result": result("imprecise"), "moments": [moment()], "counterfactuals": counterfactuals}
    assert verdict([episode])[1] == told


def test_masks_that_turn_the_outcome_are_named() -> None:
    masked = {"nothing": result(), "object: stone": result("dropped"), "object: board": result()}
    masked |= {"words: row": result("imprecise"), "the whole instruction": result("imprecise")}
    episode = {"result": result(), "moments": [moment()], "masked_episodes": masked}
    assert verdict([episode])[1] == (
        "It fails if any one of these is hidden in every step: the stone, the word for row, the whole "
        "instruction."
    )
    masked = {"nothing": result("dropped"), "object: stone": result("dropped")}
    episode = {"result": result("dropped"), "moments": [moment()], "masked_episodes": masked}
    assert verdict([episode])[1] == "Whatever single input is hidden in every step, it still fails."


AT_TARGET = {"nearest_intersection": [4, 2]}
WRONG = result("wrong_intersection")


@pytest.mark.parametrize(
    ("masked", "told"),
    [
        (
            {"object: gripper": result("imprecise", **AT_TARGET)},
            ["With the gripper hidden in every step, the stone is put down at the right intersection, row 4, "
             "column 2, not at row 3, column 2, though the episode still fails (imprecise)."],
        ),
        (
            {
                "object: gripper": result(),
                "words: row and column": result(),
                "another: color": result(),
            },
            ["With the gripper or the words for row and column hidden in every step, it succeeds."],
        ),
        # what was asked for first is the wrong place then
        ({"another: color": result(), "another: row": result("imprecise", **AT_TARGET)}, []),
        # not put down there: the stone lay there all the time, or was let fall
        ({"object: gripper": result("missed_grasp", **AT_TARGET)}, []),
        ({"object: gripper": result("dropped", **AT_TARGET)}, []),
    ],
)  # fmt: skip
def test_a_change_that_turns_a_failure_right_is_told(masked: dict[str, Any], told: list[str]) -> None:
    masked = {"nothing": WRONG, **masked}
    episode = {"result": WRONG, "moments": [moment()], "masked_episodes": masked}
    found = verdict([episode])
    assert found[0].startswith("It failed (wrong_intersection)")
    assert found[1 : len(told) + 1] == told
    assert ("Whatever single input" in " ".join(found)) is not bool(told)


def test_a_stone_that_was_never_put_down_is_put_down_right() -> None:
    held, put = result("timeout_holding", **AT_TARGET), result("imprecise", **AT_TARGET)
    masked = {"nothing": held, "object: stone": put}
    assert verdict([{"result": held, "moments": [moment()], "masked_episodes": masked}])[1] == (
        "With the stone hidden in every step, the stone is put down at the right intersection, row 4, "
        "column 2, though the episode still fails (imprecise)."
    )


def test_what_a_success_needs_is_not_called_unlooked_at() -> None:
    masked = {"nothing": result(), "object: board": result("imprecise")}
    looks = [moment("grasp", mm=seen(stone=12.0, board=0.1, background=0.0))]
    told = verdict([{"result": result(), "moments": looks, "masked_episodes": masked}])
    assert "It fails if any one of these is hidden in every step: the board." in told
    assert any("it never looked at the background: hiding it" in sentence for sentence in told)


def test_a_board_of_which_one_half_is_needed_is_not_called_unlooked_at() -> None:
    masked = {"nothing": result(), "object: board's left half": result("imprecise")}
    halves = {"board's left half": 0.0, "board's right half": 0.0}
    looks = [moment("grasp", mm=seen(stone=12.0, board=0.1, background=0.0, **halves))]
    told = verdict([{"result": result(), "moments": looks, "masked_episodes": masked}])
    assert any("it never looked at the background: hiding it" in sentence for sentence in told)


def test_what_changes_the_ending_is_not_said_to_have_no_effect() -> None:
    elsewhere = result("wrong_intersection", nearest_intersection=[0, 3])
    masked = {"nothing": WRONG, "object: background": elsewhere, "words: color": result()}
    words = {"row": 12.0, "color": 0.0, "column": 0.1}
    looks = [moment("carry", mm=seen(stone=12.0, board=0.1, background=0.0) | {"words": words})]
    told = " ".join(verdict([{"result": WRONG, "moments": looks, "masked_episodes": masked}]))
    assert "it never looked at the board: hiding it" in told
    assert "decides; the word for column does not" in told


def test_a_success_needs_no_other_words() -> None:
    masked = {"nothing": result(), "another: row": result("wrong_intersection")}
    episode = {"result": result(), "moments": [moment()], "masked_episodes": masked}
    assert verdict([episode])[1] == "Whatever single input is hidden in every step, it still succeeds."


def test_a_run_that_ended_otherwise_than_its_record_says_so() -> None:
    episode = {"result": result("imprecise"), "recorded": result(), "moments": [moment()]}
    assert verdict([episode])[1].startswith("In its record it ended otherwise (success after ")
    later = episode | {"recorded": result("imprecise", steps=77)}
    assert verdict([later])[1].startswith("In its record it ended otherwise (imprecise after 77 steps)")
    assert not verdict([episode | {"recorded": result("imprecise")}])[1].startswith("In its record")


# Several episodes


def test_several_episodes_give_means_with_intervals_over_them() -> None:
    episodes = [
        {
            "result": result(None if number else "dropped"),
            "moments": [moment("grasp", mm=seen(stone=mm, board=0.1))],
        }
        for number, mm in enumerate([10.0, 12.0, 14.0, 16.0])
    ]
    first, looks, never, _ = verdict(episodes)
    assert first == "Success: 3/4 = 75.0 % [30.1, 95.4]; failures: dropped 1."
    assert looks.startswith("It looks at the stone (13.0 mm [1") and "at grasp" in looks
    assert never.startswith(
        "In the 4 steps examined, it never looked at the board: hiding it changes the next action"
    )


def test_an_effect_whose_interval_has_zero_in_it_is_left_open() -> None:
    episodes = [
        {"result": result(), "moments": [moment("grasp", **seen(stone=nats, board=1.0))]}
        for nats in (-0.9, 1.0, -0.7, 1.2)
    ]
    assert verdict(episodes)[1].startswith("It looks at the board (")
    assert verdict(episodes)[2].startswith("No effect is shown, nor excluded, of the stone (0.15 nats [-")
