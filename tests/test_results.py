import json
from pathlib import Path

import pytest

from lerobot_bomb.cli import main
from lerobot_bomb.evaluation.results import read_results, summarise
from lerobot_bomb.schema import PROTOCOL_VERSION


def row(seed: int, failure: str | None = None, error: float = 1.0, **other: object) -> str:
    values = {
        "spec": {"seed": seed, "perturbations": "none"},
        "is_success": failure is None,
        "failure": failure,
        "placement_error_mm": error,
        "protocol_version": PROTOCOL_VERSION,
    }
    return json.dumps(values | other) + "\n"


def test_summary_counts_successes_errors_and_failures(tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    lines = [row(0), row(1, error=3.0), row(2, "imprecise", 14.0), row(3, "never_reached", 200.0)]
    lines += [row(4, "dropped", 99.0), row(5, "wrong_intersection", 45.0), row(6, "disturbed_others", 2.0)]
    path.write_text("".join(lines))
    summary = summarise(read_results(path))
    assert (summary.num_episodes, summary.num_successes) == (7, 2)
    assert summary.median_error_mm == 3.0  # of 1, 2, 3, 14 and 45: only stones that were put down
    assert summary.failures == {
        "imprecise": 1,
        "never_reached": 1,
        "dropped": 1,
        "wrong_intersection": 1,
        "disturbed_others": 1,
    }


def test_an_episode_that_was_run_again_counts_once(tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    path.write_text(row(0, "dropped") + row(1) + row(0))
    assert summarise(read_results(path)).num_successes == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no finished episode"),
        ("not json\n", "results.jsonl:1: not an episode result"),
        (row(0) + "{}\n", "results.jsonl:2: not an episode result"),
        (row(0, protocol_version="0.0"), f"protocol_version '0.0', this package has '{PROTOCOL_VERSION}'"),
    ],
)
def test_bad_files_are_named_with_the_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "results.jsonl"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_results(path)


def test_the_command_prints_a_summary(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "results.jsonl"
    path.write_text(row(0) + row(1, "dropped"))
    assert main(["results", str(path)]) == 0
    output = capsys.readouterr().out
    assert "1/2 = 50.0 %" in output
    assert "dropped 1" in output


def test_the_command_fails_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["results", str(tmp_path / "absent.jsonl")]) == 1
    error = capsys.readouterr().err
    assert "absent.jsonl: no such results file" in error
    assert error.count("\n") == 1


def test_conditions_are_not_mixed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "results.jsonl"
    specs = [{"seed": 0, "fps": 10}, {"seed": 1, "fps": 10}, {"seed": 0, "fps": 20}]
    path.write_text("".join(row(0, spec=spec | {"perturbations": "none"}) for spec in specs))
    assert main(["results", str(path)]) == 0
    output = capsys.readouterr().out
    assert "results.jsonl (fps=10): 2 episodes" in output
    assert "results.jsonl (fps=20): 1 episodes" in output


def test_a_perturbed_arm_is_compared_with_the_same_episodes_unperturbed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "results.jsonl"
    outcomes = {"none": "++++++-", "camera:3": "-----++", "all:5": "++"}  # by seed
    lines = [
        row(seed, None if outcome == "+" else "dropped", spec={"seed": seed, "perturbations": condition})
        for condition, of in outcomes.items()
        for seed, outcome in enumerate(of)
    ]
    lines.append(row(99, spec={"seed": 99, "perturbations": "all:5"}))  # has no pair
    path.write_text("".join(lines))
    assert main(["results", str(path)]) == 0
    printed = capsys.readouterr().out
    assert "camera:3: 7 pairs, 5 lost, 1 won, p = 0.22" in printed
    assert "all:5: 2 pairs, 0 lost, 0 won, p = 1 " in printed
    assert f"{path} (perturbations=none): 7 episodes" in printed


def test_what_a_file_holds_is_said_even_where_nothing_differs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "results.jsonl"
    specs = [{"seed": seed, "robot": "fetch", "perturbations": "camera:3"} for seed in (4, 7, 4)]
    path.write_text("".join(row(0, spec=spec) for spec in specs))
    assert main(["results", str(path)]) == 0
    printed = capsys.readouterr().out
    assert f"protocol {PROTOCOL_VERSION}, robot=fetch, perturbations=camera:3, seeds 4..7" in printed
    assert "1 lines count no more, a later one is of the same episode" in printed
    assert 'no unperturbed episodes to compare with; add "none" to --env.perturbations' in printed
