"""Success in a report: sentences, ranking, the numbers of its figure, and levels of an axis."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from report_cases import Rows, columns, perturbed, write
from result_rows import ACT, FDVLA, values

from lerobot_bomb.bomb.perturbations import Condition
from lerobot_bomb.commands.main import main
from lerobot_bomb.results.origin import PolicyIdentity

LEVELS = "Success over the levels of an axis"


def summary(section: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of the table of all policies."""
    return columns(section["charts"][0]["tables"][0])


def outcomes(successes: int, n: int) -> list[str | None]:
    return [None] * successes + ["dropped"] * (n - successes)


def test_conditions_of_one_seed_are_no_independent_episodes(report: Callable[..., dict[str, Any]]) -> None:
    # five seeds of ten fail under all of eleven conditions: as ten episodes, with t of 9 degrees of freedom
    conditions = [f"{axis}:{level}" for axis in ("camera", "light") for level in range(1, 6)] + ["camera:1-5"]
    section = report(perturbed(dict.fromkeys(conditions, [None, "dropped"] * 5)))["Success"]
    pooled = summary(section)[0]["perturbed"]
    assert (pooled["successes"], pooled["n"]) == (55, 110)
    assert (pooled["low"], pooled["high"]) == pytest.approx((0.2091, 0.7909), abs=1e-4)
    assert "95 % Wilson intervals, clustered by seed" in section["charts"][0]["tables"][0]["note"]
    section = report(perturbed({each: ["dropped"] for each in conditions}))["Success"]
    assert summary(section)[0]["perturbed"] == {"successes": 0, "n": 11, "low": None, "high": None}
    assert section["statements"] == [
        "act has no unperturbed episodes on place; it succeeds in 0 of 11 (0 %) perturbed ones. "
        "What a condition costs is not known: no perturbed episode was also run unperturbed."
    ]


def test_a_policy_is_told_in_one_sentence_that_is_true_for_its_number_of_episodes(
    report: Callable[..., dict[str, Any]],
) -> None:
    lost = {"none": 20, "all:3": 2, "camera:3": 8, "light:3": 18, "start:3": 20}
    told = report(perturbed({each: outcomes(number, 20) for each, number in lost.items()}))
    # 12 lost of 12: 2 x 2 / 2^12 x 3 (Holm, second of four); 18 of 18: 2 / 2^18 x 4
    assert told["Success"]["statements"] == [
        "act succeeds in 20 of 20 (100 % [84, 100]) unperturbed episodes on place, and in 2 of 20 "
        "(10 % [3, 30]) under all:3, 90 points less (p = 3.1e-05). It loses most to camera:3 (60 points "
        "less, p = 0.0015). No other axis shows a difference; about 101 seeds would show the largest, "
        "light:3 (10 points less)."
    ]


def test_a_loss_below_a_point_is_no_zero(report: Callable[..., dict[str, Any]]) -> None:
    section = report(perturbed({"none": outcomes(200, 200), "light:3": outcomes(199, 200)}))["Success"]
    assert "(no difference shown: 0.5 points less, p = 1)" in section["statements"][0]


def test_long_names_are_told_apart(report: Callable[..., dict[str, Any]]) -> None:
    both = [
        replace(ACT, path=f"pusht_act_lr{rate}_wd4_batch64_steps100k_final", weights_sha256=letter * 64)
        for rate, letter in (("0.1", "a"), ("0.01", "b"))
    ]
    told = report(*(perturbed({"none": [None]}, each) for each in both))["Success"]["statements"][1]
    first, _, second = told.partition(":")[0].partition(" against ")
    assert first != second and "…" in first and "…" in second


def test_one_episode_is_one_episode(report: Callable[..., dict[str, Any]]) -> None:
    sections = report([values(0)])
    assert sections["Success"]["statements"] == [
        "act succeeds in 1 of 1 (100 % [21, 100]) unperturbed episodes on place."
    ]
    assert "Why episodes failed" not in sections and "Every policy under every condition" not in sections


def test_policies_are_ranked_on_the_episodes_that_all_have(report: Callable[..., dict[str, Any]]) -> None:
    act = perturbed({"none": [None] * 3, "camera:3": [None, None, "dropped"], "all:5": ["dropped"] * 3})
    fdvla = perturbed({"none": [None, "dropped"], "camera:3": [None, "dropped"], "light:1": [None]}, FDVLA)
    section = report(act, fdvla)["Success"]
    assert [row["on shared episodes"]["n"] for row in summary(section)] == [2, 2]
    assert section["statements"][:2] == [
        "Ranking on place by the 2 unperturbed episodes that all policies have: act 100 %, fdvla 50 %.",
        "act against fdvla: unperturbed, not significant: act leads by 50 points [-27, 91] (2 pairs, "
        "p = 1; about 17 pairs would settle it). Under camera:3, not significant: act leads by 50 points "
        "[-27, 91] (2 pairs, p = 1; about 17 pairs would settle it).",
    ]
    assert section["lines"] == [
        "act, place: 5 of its 9 episodes were not run by all policies; pairs and ranking leave them out",
        "fdvla, place: 1 of its 5 episodes were not run by all policies; pairs and ranking leave them out",
    ]


def test_a_tie_is_a_tie_and_what_is_sure_is_said(report: Callable[..., dict[str, Any]]) -> None:
    act = perturbed({"none": outcomes(9, 10), "all:3": outcomes(10, 10), "light:3": outcomes(0, 10)})
    fdvla = perturbed({"none": outcomes(9, 10), "all:3": outcomes(0, 10), "light:3": outcomes(10, 10)}, FDVLA)
    assert report(act, fdvla)["Success"]["statements"][:2] == [
        "Ranking on place by the 10 unperturbed episodes that all policies have: act and fdvla tie at 90 %.",
        "act against fdvla: unperturbed, they tie (9 successes each in 10 pairs). Of 2 perturbed conditions, "
        "act is significantly better under 1, most under all:3 (by 100 points) and fdvla is significantly "
        "better under 1, most under "
        "light:3 (by 100 points).",
    ]
    better = perturbed({"none": outcomes(10, 10)}), perturbed({"none": outcomes(1, 10)}, FDVLA)
    assert report(*better)["Success"]["statements"][1] == (
        "act against fdvla: unperturbed, act is better by 90 points [49, 98] (10 pairs, p = 0.0039)."
    )


def test_policies_without_a_common_episode_are_not_ranked(report: Callable[..., dict[str, Any]]) -> None:
    section = report(perturbed({"light:3": [None]}), perturbed({"camera:3": [None]}, FDVLA))["Success"]
    assert section["statements"][0] == ("No ranking on place: act and fdvla have no episode in common.")
    assert [row["on shared episodes"] for row in summary(section)] == ["-", "-"]


def test_other_settings_are_panels_of_their_own(report: Callable[..., dict[str, Any]]) -> None:
    small = [row | {"image_size": 64} for row in perturbed({"light:1": [None]}, FDVLA)]
    section = report(perturbed({"camera:3": ["dropped"] * 3}), small)["Success"]
    assert [row["on shared episodes"] for row in summary(section)] == ["-", "-"]
    assert section["lines"] == [] and "image_size 64" in section["statements"][1]


def test_long_settings_tell_panels_apart(report: Callable[..., dict[str, Any]]) -> None:
    renderers = (
        "llvmpipe (LLVM 15.0.7, 256 bits)",
        "NVIDIA H200/PCIe/SSE2",
        "llvmpipe (LLVM 16.0.7, 256 bits)",
    )
    rows = [values(0) | {"opengl_renderer": each} for each in renderers]
    said = [text.split(" unperturbed")[-1] for text in report(rows)["Success"]["statements"]]
    names = ["Mesa, llvmpi…, 256 bits) (1)", "Mesa, NVIDIA…0/PCIe/SSE2", "Mesa, llvmpi…, 256 bits) (2)"]
    assert [text.partition(" OpenGL ")[2].rstrip(".") for text in said] == names


@pytest.mark.parametrize("version", ["1.0", "1.1"])
def test_the_version_of_a_task_is_said_where_the_suite_has_several(
    version: str, report: Callable[..., dict[str, Any]]
) -> None:
    place = values(0)
    other = place["spec"] | {"suite": "object"}
    rows = [
        place,
        *(place | {"spec": other, "task_id": 0, "task_version": each} for each in {version, "1.1"}),
    ]
    said = " ".join(report(rows)["Success"]["statements"])
    assert ("task_version 1.1" in said) == (version == "1.0")


def test_the_numbers_say_of_what_the_measures_are(report: Callable[..., dict[str, Any]]) -> None:
    section = report([values(0)])["Success"]
    assert "placement error" in summary(section)[0]["measures"]
    note = section["charts"][0]["tables"][0]["note"]
    assert "placement error: median" in note and "moves made" not in note


def test_a_name_that_is_given_stands_everywhere(
    report: Callable[..., dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = perturbed({"none": [None], "light:3": ["dropped"]}) + perturbed({"none": [None]}, FDVLA)
    sections = report(rows, flags=("--names=act=the baseline,me/fdvla=ours",))
    assert [row["policy, suite"] for row in summary(sections["Success"])] == [
        "the baseline, place",
        "ours, place",
    ]
    page = (tmp_path / "out" / "r.html").read_text()
    assert "<h1>the baseline and ours on bomb (place): 3 episodes, 2 conditions</h1>" in page
    path = str(write(tmp_path / "r.jsonl", rows))
    assert main(["report", path, f"--output={tmp_path / 'r.html'}", "--names=pi0=x"]) == 1
    assert "--names: pi0 must name one policy of the file, not 0: act outputs/act" in capsys.readouterr().err
    for wrong in ("act", "act=", "=x", "act=x,fdvla=x"):
        with pytest.raises(SystemExit, match="2"):
            main(["report", path, f"--names={wrong}"])
        assert "must be POLICY=NAME, several joined by commas" in capsys.readouterr().err


def test_many_policies_and_conditions_are_ranked_and_the_rest_is_counted(
    report: Callable[..., dict[str, Any]], tmp_path: Path
) -> None:
    pairs = [f"{axis}:{level}+start:{level}" for axis in ("camera", "light", "table") for level in (1, 2, 3)]
    singles = [f"{axis}:{level}" for axis in ("camera", "light", "table", "object") for level in range(1, 6)]
    policies = [PolicyIdentity("act", f"outputs/run_{number}/last") for number in range(8)]
    rows = [
        row
        for number, policy in enumerate(policies)
        for row in perturbed(dict.fromkeys(["none", *singles, *pairs], outcomes(number > 2, 1)), policy)
    ]
    sections = report(rows)
    assert (
        "<h1>8 policies on bomb (place): 240 episodes, 30 conditions</h1>"
        in (tmp_path / "out" / "r.html").read_text()
    )
    (chart,) = sections["Success"]["charts"]
    assert chart["title"] == "Success by policy, unperturbed and perturbed" and len(chart["tables"]) == 10
    assert sections["Success"]["statements"][0] == (
        "Ranking on place by the one unperturbed episode that all policies have: act run_3, act run_4, "
        "act run_5 and 2 more tie at 100 %, act run_0, act run_1 and act run_2 tie at 0 %."
    )
    (chart,) = sections["Every policy under every condition"]["charts"]
    (table,) = chart["tables"]
    shown = {"unperturbed", "camera:5", "light:5", "table:5", "object:5"}
    assert {*table["header"][1:]} == shown | {str(Condition(each)) for each in pairs if each.endswith(":3")}
    assert "Shown: 8 of 30 conditions" in chart["note"]
    assert [row[0] for row in table["rows"]][:5] == [f"act run_{number}" for number in range(3, 8)]


# Levels of axes


def at_levels(condition: str, levels: dict[str, int], failures: Sequence[str | None]) -> Rows:
    return [
        values(seed, failure, spec={"perturbations": condition}, levels=levels)
        for seed, failure in enumerate(failures)
    ]


def test_a_slope_is_of_the_episodes_in_which_the_axis_alone_was_on(
    report: Callable[..., dict[str, Any]],
) -> None:
    lost, half, won = ["dropped"] * 4, [None, None, "dropped", "dropped"], [None] * 4
    rows = [
        *at_levels("none", {}, won),
        *at_levels("camera:2", {"camera": 2}, half),
        *at_levels("camera:4", {"camera": 4}, lost),
        *at_levels("camera:4+light:4", {"camera": 4, "light": 4}, won),
        *at_levels("object:5", {"object": 5}, won),
    ]
    _, table = report(rows)[LEVELS]["charts"][0]["tables"]
    (camera, other) = columns(table)
    assert (camera["axis"], other["axis"]) == ("camera", "object")
    assert camera["points per level"]["per_level"] == pytest.approx(-0.25)  # 1, 1/2, 0 at the levels 0, 2, 4
    # every seed falls from 1 to 0 over four levels, whatever it has between
    assert camera["points per level"]["low"] is None
    assert other["points per level"] == {"per_level": 0.0, "low": None, "high": None}
    assert {row["share of variance"] for row in (camera, other)} == {""}


def test_one_level_of_an_axis_alone_says_nothing_of_it(report: Callable[..., dict[str, Any]]) -> None:
    one_level = at_levels("camera:2", {"camera": 2}, [None, "dropped"])
    assert LEVELS not in report(one_level)
    one_range = [
        *at_levels("camera:1-5", {"camera": 1}, [None, None]),
        *at_levels("camera:1-5+light:3", {"camera": 2, "light": 3}, [None, "dropped"]),
        *at_levels("camera:1-5+light:3", {"camera": 5, "light": 3}, ["dropped", "dropped"]),
    ]
    assert LEVELS not in report(one_range)


def test_shares_are_of_the_episodes_in_which_several_levels_were_drawn(
    report: Callable[..., dict[str, Any]],
) -> None:
    drawn = [
        row | {"levels": {"camera": 1 + seed % 2, "light": 1 + seed // 2 % 2}}
        for seed, row in enumerate(
            at_levels("camera:1-2+light:1-2", {}, [None, "dropped", None, "dropped"] * 2)
        )
    ]
    fixed = at_levels("camera:3+light:3", {"camera": 3, "light": 3}, [None, "dropped"])
    (table,) = report([*drawn, *fixed])[LEVELS]["tables"]
    shares = {row["axis"]: row["share of variance"] for row in columns(table)}
    # total 2 of 8 episodes, 7 degrees of freedom; within the levels of light 2, with 6
    assert shares == {"camera": pytest.approx(1.0), "light": pytest.approx(1 - (2 / 6) / (2 / 7))}


# Efficiency
