"""``lerobot-bomb compare``: two policies on the same episodes."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from result_rows import ACT, FDVLA, values

from lerobot_bomb.commands.arguments import ANSWER_IS_NO
from lerobot_bomb.commands.main import main

type Printed = pytest.CaptureFixture[str]


def write(path: Path, failures: list[str | None], condition: str = "none", **other: Any) -> Path:
    """A line for each seed from 0 on, appended to the file."""
    with path.open("a") as file:
        for seed, failure in enumerate(failures):
            line = values(seed, failure, spec={"perturbations": condition}, **other)
            file.write(json.dumps(line) + "\n")
    return path


@pytest.fixture
def a(tmp_path: Path) -> Path:
    return tmp_path / "a.jsonl"


@pytest.fixture
def b(tmp_path: Path) -> Path:
    return tmp_path / "b.jsonl"


def compare(*flags: str | Path) -> int:
    return main(["compare", *map(str, flags)])


def test_pairs_are_counted_by_condition(a: Path, b: Path, capsys: Printed) -> None:
    for condition, lost in (("none", 1), ("camera:3", 8)):
        write(a, [None] * 12, condition)
        write(b, ["dropped"] * lost + [None] * (10 - lost), condition, policy=FDVLA)
    assert compare(a, b) == 0
    out = capsys.readouterr().out
    assert "A: act outputs/act" in out and "B: fdvla me/fdvla" in out
    nominal, perturbed = out.split("camera:3: 10 pairs")
    assert "none: 10 pairs" in nominal and "B - A      -10.0 points" in nominal
    assert "A alone succeeded in 8, B alone in 0 of 10 pairs, p = 0.016" in perturbed  # 2 * 2 / 256
    assert "not compared, since only one has them: 4 episodes of A, 0 of B" in out
    few = "A leads by 10 points [-19, 40] (10 pairs, p = 1; about 90 pairs would settle it)"
    assert out.splitlines()[:4] == [
        "A is act, B is fdvla",
        "of 2 conditions: A is better under 1, no significant difference under 1",
        f"  none: not significant: {few}",
        "  camera:3: A is better by 80 points [38, 94] (10 pairs, p = 0.016)",
    ]


def test_the_number_of_pairs_is_one_in_which_the_test_that_is_used_finds_the_difference(
    a: Path, b: Path, capsys: Printed
) -> None:
    write(a, [None] * 4)
    write(b, ["dropped"] * 4, policy=FDVLA)
    assert compare(a, b) == 0
    out = capsys.readouterr().out
    told = out.splitlines()[1]
    assert "A leads by 100 points" in told and "(4 pairs, p = 0.12; about 6 pairs would settle it)" in told
    assert "p: exact McNemar test of one condition, not adjusted" in out
    write(a, [None] * 4, "light:3")
    write(b, [None] * 4, "light:3", policy=FDVLA)
    assert compare(a, b) == 0  # of two conditions: 2 / 2^7 is the first below 0.05 / 2
    out = capsys.readouterr().out
    assert "(4 pairs, p = 0.25; about 7 pairs would settle it)" in out
    assert "  light:3: they tie (4 successes each in 4 pairs)\n" in out
    assert "p: exact McNemar test, adjusted for 2 conditions (Holm)" in out


def test_less_than_a_point_has_a_decimal(a: Path, b: Path, capsys: Printed) -> None:
    write(a, ["dropped"] * 2 + [None] * 248)
    write(b, [None] * 250, policy=FDVLA)
    assert compare(a, b) == 0
    assert "B leads by 0.8 points [-0.8, 2.9] (250 pairs" in capsys.readouterr().out


def test_what_must_not_be_pooled_is_compared_apart(a: Path, b: Path, capsys: Printed) -> None:
    for image_size, failure in ((256, None), (64, "dropped")):
        write(a, [None] * 3, image_size=image_size)
        write(b, [failure] * 3, image_size=image_size, policy=FDVLA)
    assert compare(a, b) == 0
    out = capsys.readouterr().out
    assert "image_size 256, none: 3 pairs" in out and "image_size 64, none: 3 pairs" in out


def test_renderers_of_either_side_are_compared_apart(a: Path, b: Path, capsys: Printed) -> None:
    for seed, renderer, failure in ((0, "llvmpipe", None), (1, "H200", "dropped")):
        for path, policy, drawn in ((a, ACT, None), (b, FDVLA, renderer)):
            line = values(seed, failure, policy=policy, opengl_vendor=drawn, opengl_renderer=drawn)
            with path.open("a") as file:
                file.write(json.dumps(line) + "\n")
    for files in ((a, b), (b, a)):
        assert compare(*files) == 0
        out = capsys.readouterr().out
        assert "OpenGL llvmpipe, llvmpipe, none: 1 pair" in out and "OpenGL H200, H200, none: 1 pair" in out


def test_pairs_that_share_seeds_are_said_to(a: Path, b: Path, capsys: Printed) -> None:
    for target in ((0, 0), (1, 1)):
        for path, policy in ((a, ACT), (b, FDVLA)):
            with path.open("a") as file:
                lines = [
                    values(seed, spec={"target": target, "color": "black"}, task_ids=[0, 6])
                    for seed in (0, 1)
                ]
                file.writelines(json.dumps(line | {"policy": asdict(policy)}) + "\n" for line in lines)
    assert compare(a, b) == 0
    out = capsys.readouterr().out
    assert "none: 4 pairs of 2 seeds\n" in out and "(Holm)" not in out
    assert "not adjusted, which takes pairs of one seed as independent\n" in out


def test_tasks_of_one_seed_show_nothing(a: Path, b: Path, capsys: Printed) -> None:
    numbers = range(20)
    for seed, expected in ((0, ANSWER_IS_NO), (1, 0)):
        for path, policy, failure in ((a, ACT, "dropped"), (b, FDVLA, None)):
            with path.open("a") as file:
                for task in numbers:
                    spec = {"target": divmod(task, 5), "color": "black"}
                    line = values(seed, failure, policy=policy, spec=spec, task_ids=[*numbers])
                    file.write(json.dumps(line) + "\n")
        output = a.with_suffix(".tex")
        assert compare(a, b, "--min_difference=5", "--non_inferior=5", f"--output={output}") == expected
        if seed == 0:
            assert "& $+100.0$ &" in output.read_text()
            out = capsys.readouterr().out
            assert "not shown: B leads by 100 points (20 pairs of 1 seed, p = 1.9e-06)" in out
            assert out.count("points or more: not shown (all pairs are of one seed under none)") == 1
    assert "B - A      +100.0 points [+7.0, +100.0]" in capsys.readouterr().out  # as of two pairs


def test_the_exit_code_says_whether_a_difference_is_shown(a: Path, b: Path, capsys: Printed) -> None:
    write(a, ["dropped"] * 60 + [None] * 40)
    write(b, ["dropped"] * 10 + [None] * 90, policy=FDVLA)
    assert compare(a, b, "--min_difference=35", "--non_inferior=5") == 0  # +50 [+39, +59]
    assert compare(a, b, "--min_difference=45") == ANSWER_IS_NO
    assert "--min_difference=45: B is better by 45 points or more: not shown" in capsys.readouterr().out
    assert compare(b, a, "--non_inferior=65") == 0
    assert compare(b, a, "--non_inferior=55") == ANSWER_IS_NO


def test_every_condition_must_reach_the_bar(a: Path, b: Path) -> None:
    write(a, [None] * 100)
    write(b, [None] * 100, policy=FDVLA)
    assert compare(a, b, "--non_inferior=5") == 0
    write(a, [None] * 100, "light:3")
    write(b, ["dropped"] * 5 + [None] * 95, "light:3", policy=FDVLA)
    assert compare(a, b, "--non_inferior=5") == ANSWER_IS_NO


def test_a_condition_without_pairs_is_not_shown(a: Path, b: Path, capsys: Printed) -> None:
    write(a, ["dropped"] * 50)
    write(b, [None] * 50, policy=FDVLA)
    assert compare(a, b, "--non_inferior=5", "--min_difference=50") == 0
    write(a, [None] * 3, "light:3")
    write(a, [None] * 50, image_size=64)
    for files, side in (((a, b), "A"), ((b, a), "B")):
        capsys.readouterr()
        assert compare(*files, "--non_inferior=100", "--min_difference=0") == ANSWER_IS_NO
        out = capsys.readouterr().out
        lacking = f"no pairs under image_size 256, light:3 and image_size 64, none of {side}"
        assert out.count(f"points: not shown ({lacking})") == 1
        assert f"; {lacking}\n" in out


def test_what_is_measured_is_compared_where_both_have_it(a: Path, b: Path, capsys: Printed) -> None:
    write(a, ["never_reached", *[None] * 4], error=1.0)
    write(b, [None] * 5, error=3.5, policy=FDVLA)
    assert compare(a, b) == 0
    expected = "placement error +2.5 mm where both put the stone down (4 pairs)"
    assert expected in capsys.readouterr().out


def test_an_episode_that_was_run_again_counts_once(a: Path, b: Path, capsys: Printed) -> None:
    write(a, ["dropped"] * 3)
    write(a, [None] * 3)
    write(b, [None] * 3, policy=FDVLA)
    assert compare(a, b) == 0
    out = capsys.readouterr().out
    assert "none: 3 pairs" in out and "B - A      +0.0 points" in out


def test_an_expert_without_images_compares_with_a_policy_that_sees_some(
    a: Path, b: Path, capsys: Printed
) -> None:
    write(a, [None] * 3, opengl_vendor=None, opengl_renderer=None)
    write(b, [None] * 3, policy=FDVLA)
    assert compare(a, b) == 0
    assert "none: 3 pairs" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"image_size": 96}, "they differ in image_size"),
        ({"mujoco_version": "3.9.0", "opengl_renderer": "swrast"}, "they differ in MuJoCo, OpenGL"),
        ({"condition": "light:3"}, "have nothing in common; evaluate both with the same --seed and flags"),
    ],
)
def test_without_common_episodes_it_says_what_differs(
    a: Path, b: Path, other: dict[str, Any], message: str, capsys: Printed
) -> None:
    write(a, [None] * 3)
    write(b, [None] * 3, policy=FDVLA, **other)
    assert compare(a, b) == 1
    assert message in capsys.readouterr().err


def test_several_policies_in_one_file_are_refused(a: Path, b: Path, capsys: Printed) -> None:
    write(a, [None] * 3)
    write(a, [None] * 3, policy=FDVLA)
    write(b, [None] * 3, policy=ACT)
    assert compare(a, b) == 1
    told = capsys.readouterr().err
    assert "the first results are of 2 policies (act outputs/act (" in told and "); fdvla " in told


def test_two_policies_of_one_file_are_chosen_by_name(a: Path, capsys: Printed) -> None:
    write(a, [None] * 3)
    write(a, ["dropped"] * 3, policy=FDVLA)
    assert compare(a) == 0
    assert "B - A      -100.0 points" in capsys.readouterr().out
    assert compare(a, "--policies=me/fdvla,outputs/act") == 0
    assert "B - A      +100.0 points" in capsys.readouterr().out
    write(a, [None] * 3, policy=replace(FDVLA, type="fdvla_two"))
    assert compare(a, "--policies=act,fdvla") == 0  # the type alone, not what it begins
    assert "\nB: fdvla me/fdvla" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ((), "two policies are compared, not 3 (act outputs/act"),
        (("--policies=act",), "two policies are compared, not 1 (act outputs/act"),
        (("--policies=act,pi0",), "pi0 must name one policy of the file, not 0: act outputs/act"),
        (("--policies=act,me/",), "me/ must name one policy of the file, not 2"),
        (("b.jsonl", "--policies=act,fdvla"), "--policies chooses two of one file"),
    ],
)
def test_what_names_no_two_policies_is_refused(
    flags: tuple[str, ...], message: str, a: Path, capsys: Printed
) -> None:
    for policy in (ACT, FDVLA, replace(FDVLA, type="fdvla_two")):
        write(a, [None], policy=policy)
    assert compare(a, *flags) == 1
    assert message in capsys.readouterr().err


def test_damaged_lines_are_told_and_not_counted(a: Path, b: Path, capsys: Printed) -> None:
    write(a, [None] * 3)
    write(b, [None] * 3, policy=FDVLA)
    a.write_text(a.read_text() + '{"spec": {"se')
    assert compare(a, b) == 0
    assert f"{a}:4: not an episode result" in capsys.readouterr().err


@pytest.mark.parametrize("points", ["-1", "101", "five", "nan"])
def test_points_that_cannot_be_are_refused(a: Path, points: str, capsys: Printed) -> None:
    with pytest.raises(SystemExit):
        compare(a, a, f"--min_difference={points}")
    assert "must be points of a success rate, 0..100" in capsys.readouterr().err


def test_a_file_of_one_policy_asks_for_another_file(a: Path, capsys: Printed) -> None:
    write(a, [None], policy=ACT)
    assert compare(a) == 1
    assert "; name the file of a second one" in capsys.readouterr().err
