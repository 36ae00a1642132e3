"""Effects that were planted in a policy: comparison, report and sweep show them, and nothing else."""

import json
import os
import re
from pathlib import Path
from typing import Any

import pytest
from result_rows import FDVLA, values
from scipy.stats import binomtest

from lerobot_bomb.commands.arguments import ANSWER_IS_NO
from lerobot_bomb.commands.main import main
from lerobot_bomb.results.groups import read_results

type Printed = pytest.CaptureFixture[str]
ONLY_A, ONLY_B = 32, 12  # of 400 pairs, in which one of the two alone succeeds


def run(command: str, *arguments: str | Path) -> int:
    return main([command, *map(str, arguments)])


# Five points worse


def write(path: Path, successes: list[bool], **other: Any) -> Path:
    """A line for each seed from 0 on."""
    lines = (values(seed, None if is_won else "dropped", **other) for seed, is_won in enumerate(successes))
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return path


def five_points_apart(folder: Path, scale: int = 1) -> tuple[Path, Path]:
    """Files of two policies, A right in 90 % of 400 / `scale` episodes, B in 85 %."""
    only_a, only_b, both = ONLY_A // scale, ONLY_B // scale, 328 // scale
    neither = 400 // scale - only_a - only_b - both
    a = [True] * only_a + [False] * only_b + [True] * both + [False] * neither
    b = [False] * only_a + [True] * only_b + [True] * both + [False] * neither
    return write(folder / "a.jsonl", a), write(folder / "b.jsonl", b, policy=FDVLA)


def test_five_points_less_in_400_pairs_are_shown(tmp_path: Path, capsys: Printed) -> None:
    a, b = five_points_apart(tmp_path)
    assert run("compare", a, b) == 0
    out = capsys.readouterr().out
    assert "360/400 = 90.0 %" in out and "340/400 = 85.0 %" in out
    p_value = binomtest(ONLY_B, ONLY_A + ONLY_B).pvalue
    assert p_value < 0.05
    assert f"A alone succeeded in 32, B alone in 12 of 400 pairs, p = {p_value:.2g}" in out
    assert "B - A      -5.0 points [-8." in out
    assert (
        out.splitlines()[1].startswith("A is better by 5 points [2, 8] (400 pairs")
        and "would show" not in out
    )


def test_it_is_no_worse_than_by_ten_points_and_may_be_by_three(tmp_path: Path) -> None:
    a, b = five_points_apart(tmp_path)
    assert run("compare", a, b, "--non_inferior=10") == 0
    assert run("compare", a, b, "--non_inferior=3") == ANSWER_IS_NO
    assert run("compare", b, a, "--min_difference=1") == 0
    assert run("compare", b, a, "--min_difference=5") == ANSWER_IS_NO


def test_in_100_pairs_the_same_difference_is_not_shown_and_it_says_how_many_are_needed(
    tmp_path: Path, capsys: Printed
) -> None:
    a, b = five_points_apart(tmp_path, scale=4)
    assert run("compare", a, b, "--non_inferior=5") == ANSWER_IS_NO
    out = capsys.readouterr().out
    assert "B - A      -5.0 points [" in out and "of 100 pairs, p = 0.23" in out
    told = r"not significant: A leads by 5 points \[-\d+, \d+\] \(100 pairs, p = 0\.23; about \d+ .*"
    assert re.fullmatch(told, out.splitlines()[1])


def test_the_report_says_the_same(tmp_path: Path) -> None:
    a, b = five_points_apart(tmp_path)
    assert run("report", a, b, f"--output={tmp_path / 'r.html'}") == 0
    sections = {each["title"]: each for each in json.loads((tmp_path / "r.json").read_text())}
    (table,) = sections["Two policies on the same episodes"]["tables"]
    ((_, first, second, points, p_value, n),) = table["rows"]
    assert (first["successes"], second["successes"], n) == (360, 340, 400)
    assert points["difference"] == pytest.approx(-0.05) and points["low"] < points["high"] < 0
    assert (points["only_first"], points["only_second"]) == (ONLY_A, ONLY_B)
    assert p_value == pytest.approx(binomtest(ONLY_B, ONLY_A + ONLY_B).pvalue)


# An error in every tenth episode


@pytest.mark.long
def test_a_rate_says_how_many_are_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Printed
) -> None:
    paths = [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))
    flags = ["--env.type=bomb", "--env.image_size=32", "--env.fps=2", "--policy.device=cpu"]
    flags += ["--policies=every_tenth", "--env.discover_packages_path=every_tenth"]
    assert run("sweep", tmp_path, "--episodes=10", "--batch_size=1", *flags) == 1
    out = capsys.readouterr().out
    assert "9 of 10 episodes, 1 of 1 jobs" in out
    assert "1 episodes have no result, an error ended them" in out
    assert "1 x ArithmeticError: planted in the tenth episode" in out
    assert f"to run them again: lerobot-bomb sweep {tmp_path} --retry" in out
    errors = [json.loads(line) for line in (tmp_path / "errors.jsonl").read_text().splitlines()]
    assert [error["seed"] for error in errors] == [1009]
    results = tmp_path / "results.jsonl"
    seeds = [record.spec.seed for record in read_results(results)]
    assert seeds == [*range(1000, 1009)]

    assert run("results", results, "--verbose") == 0
    said = capsys.readouterr()
    assert "0/9 = 0.0 %" in said.out
    assert f"episodes are missing; an error ended 1: {tmp_path / 'errors.jsonl'}" in said.err

    monkeypatch.setenv("EVERY_TENTH_IS_MENDED", "1")
    assert run("sweep", tmp_path, "--retry") == 0
    assert "10 of 10 episodes, 1 of 1 jobs" in capsys.readouterr().out
    assert run("results", results, "--verbose") == 0
    said = capsys.readouterr()
    assert "0/10 = 0.0 %" in said.out and "missing" not in said.err
