"""``lerobot-bomb results smoothness``; tests/test_smoothness.py has the mathematics."""

import json
from pathlib import Path

import numpy as np
import pytest
from pusht_cases import REPO_ID, Demonstrations

from lerobot_bomb.commands.main import main
from lerobot_bomb.evaluation.executed import ActionLog, append_episode
from lerobot_bomb.evaluation.smoothness_report import (
    ORDERS,
    make_units,
    measure_difference,
    measure_row,
    print_rows,
)

PARABOLA = np.array([[0.0], [1], [3], [6], [10]])  # second differences 1, third 0
NAMES = ["x", "y", "Gripper.pos"]


def executed(name: str, *episodes: np.ndarray, fps: float = 10) -> ActionLog:
    return ActionLog(name, fps, {str(i): actions for i, actions in enumerate(episodes)}, True)


def test_a_row_by_hand() -> None:
    log = executed("a", PARABOLA, 3 * PARABOLA[:4], PARABOLA[:3])
    units = make_units(log, ["x"], None, per_second=False)
    row = measure_row(log, units)
    std = np.concatenate([PARABOLA, 3 * PARABOLA[:4], PARABOLA[:3]]).std()
    assert {key: estimate.mean for key, estimate in row.measures.items()} == pytest.approx(
        {"J2": (3 * 1 + 2 * 3) / 5, "J3": 0, "J2, normalised": 9 / 5 / std, "J3, normalised": 0}
    )
    assert (row.num_skipped, row.num_actions) == (1, {"0": 5, "1": 4})
    assert [measures["J2"] for measures in row.episodes.values()] == [1, 3]


def test_the_printed_row(capsys: pytest.CaptureFixture[str]) -> None:
    log = executed("a", PARABOLA, 3 * PARABOLA[:4], PARABOLA[:3])
    print_rows({"a": measure_row(log, make_units(log, ["x"], [], per_second=False))})
    header, row, note = capsys.readouterr().out.splitlines()
    assert header.split() == ["episodes", "actions", *" ".join(ORDERS).split()]
    assert row.split()[:3] == ["a", "2", "9"]
    assert note == "a: 1 more with fewer than 4 actions do not count"


def test_per_second() -> None:
    log = executed("a", PARABOLA**2, fps=20)
    step, second = (
        measure_row(log, make_units(log, ["x"], None, per_second)) for per_second in (False, True)
    )
    for key, order in ORDERS.items():
        assert second.measures[key].mean == pytest.approx(20**order * step.measures[key].mean)


def test_grippers_are_left_out_by_name() -> None:
    rng = np.random.default_rng(0)
    log = executed("a", rng.normal(size=(9, 3)))
    assert make_units(log, NAMES, None, False).exclude == [2]
    assert make_units(log, NAMES, [], False).exclude == []
    assert make_units(log, NAMES, ["y", "x"], False).exclude == [1, 0]
    without = executed("a", log.episodes["0"][:, :2])
    expected = measure_row(without, make_units(without, NAMES[:2], None, False))
    assert measure_row(log, make_units(log, NAMES, None, False)) == expected


def test_conditions_of_one_seed_are_drawn_together() -> None:
    rng = np.random.default_rng(0)
    rough = [scale * rng.normal(size=(30, 1)) for scale in (1, 5, 20)]
    alone = ActionLog(
        "alone", 10, {f"none, task 0, seed {i}": actions for i, actions in enumerate(rough)}, True
    )
    groups = ("none", "light-3", "all-5")
    thrice = {f"{group}, task 0, seed {i}": actions for group in groups for i, actions in enumerate(rough)}
    units = make_units(alone, ["x"], None, False)
    rows = {log.name: measure_row(log, units) for log in (alone, ActionLog("thrice", 10, thrice, True))}
    halved = {name: actions / (1 + i % 3) for i, (name, actions) in enumerate(thrice.items())}
    rows["halved"] = measure_row(ActionLog("halved", 10, halved, True), units)
    for key in ORDERS:
        first, second = (rows[name].measures[key] for name in ("alone", "thrice"))
        assert (second.low, second.high) == pytest.approx((first.low, first.high))
    one, three = (measure_difference(name, "halved", rows).measures["J2"] for name in ("alone", "thrice"))
    assert (three.low, three.high) == pytest.approx((one.low, one.high))


def test_differences_are_those_of_pairs() -> None:
    rng = np.random.default_rng(0)
    rough = [scale * rng.normal(size=(30, 2)) for scale in (1, 5, 20, 100)]  # episodes that differ much
    first = executed("first", *rough, rough[0])
    second = executed("second", *(1.1 * actions for actions in rough))
    units = make_units(first, ["x", "y"], None, False)
    rows = {log.name: measure_row(log, units) for log in (first, second)}
    difference = measure_difference("first", "second", rows)
    assert difference.num_pairs == 4
    expected = measure_row(executed("of pairs", *rough), units)
    for key, estimate in difference.measures.items():
        assert estimate.mean == pytest.approx(0.1 * expected.measures[key].mean)
        # every pair says the same, so the interval is that of the mean, a tenth as wide
        low, high = expected.measures[key].low, expected.measures[key].high
        assert low is not None and high is not None
        assert (estimate.low, estimate.high) == pytest.approx((0.1 * low, 0.1 * high))
    rows["third"] = measure_row(ActionLog("third", 10, {"other": rough[0]}, True), units)
    with pytest.raises(ValueError, match="first and third have no episode of the same group, task and seed"):
        measure_difference("first", "third", rows)


@pytest.fixture
def logs(pusht_demonstrations: Demonstrations, tmp_path: Path) -> list[Path]:
    """The demonstrations as if two policies had executed them, the second with a seam every eight actions."""
    starts = [0, *pusht_demonstrations.ends[:-1]]
    paths = [tmp_path / name for name in ("smooth.jsonl", "seams.jsonl")]
    for seed, (start, end) in enumerate(zip(starts, pusht_demonstrations.ends, strict=True)):
        actions = pusht_demonstrations.actions[start:end].astype(np.float64)
        append_episode(paths[0], "pusht", 0, seed, 10, actions)
        seams = actions + 10 * (np.arange(len(actions)) // 8 % 2)[:, None]
        append_episode(paths[1], "pusht", 0, seed, 10, seams)
    return paths


def test_people_and_policies_side_by_side(
    pusht_demonstrations: Demonstrations,
    pusht_dataset: Path,
    logs: list[Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / "figures.json"
    flags = [f"--dataset.repo_id={REPO_ID}", f"--dataset.root={pusht_dataset}", f"--json={path}"]
    assert main(["results", "smoothness", *flags, *map(str, logs), str(pusht_dataset)]) == 0
    output = capsys.readouterr()
    assert output.err == ""
    assert output.out.startswith("action dims target_x, target_y; left out: none\n")
    assert f"Difference from {logs[0]} on the same episodes" in output.out
    figures = json.loads(path.read_text())
    people, smooth, seams, folder = figures["rows"].values()
    assert smooth["measures"] == people["measures"] == folder["measures"]
    assert list(people["episodes"]) == ["0", "1", "2"]
    assert list(seams["episodes"]) == [f"pusht, task 0, seed {seed}" for seed in range(3)]
    std = pusht_demonstrations.actions.astype(np.float64).std(axis=0)
    assert figures["std"] == pytest.approx(std)
    [(name, difference)] = figures["differences"].items()
    assert (name, difference["from"], difference["num_pairs"]) == (str(logs[1]), str(logs[0]), 3)
    for key, estimate in difference["measures"].items():
        assert estimate["mean"] == pytest.approx(
            seams["measures"][key]["mean"] - smooth["measures"][key]["mean"]
        )
        assert 0 < estimate["low"] < estimate["mean"] < estimate["high"]


def test_rates_that_differ_are_told(
    pusht_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "fast.jsonl"
    append_episode(log, "pusht", 0, 1, 20, np.arange(10.0).reshape(5, 2) ** 2)
    flags = [f"--dataset.repo_id={REPO_ID}", f"--dataset.root={pusht_dataset}", str(log)]
    for more, is_told in ([], True), (["--per_second"], False), (["--fps=10"], False):
        assert main(["results", "smoothness", *flags, *more]) == 0
        assert ("has 20 actions a second" in capsys.readouterr().err) == is_told


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--exclude=gripper"], r"no action dim 'gripper'; there are \['target_x', 'target_y'\]"),
        (["--exclude=target_x,target_y"], "leaves none of the action dims"),
        (["--fps=0"], "--fps=0 must be a positive number"),
        (["--fps=nan"], "--fps=nan must be a positive number"),
        (["--json=absent/figures.json"], "--json=absent/figures.json cannot be written"),
        (["--json=short.jsonl"], "--json=short.jsonl exists already; name a new file"),
        (
            ["absent.jsonl"],
            "absent.jsonl: no such file or folder; `lerobot-bomb results actions absent.jsonl",
        ),
        (["short.jsonl"], "short.jsonl: no episode has 4 actions"),
        (["three.jsonl"], f"three.jsonl: actions have 3 dims, those of {REPO_ID} 2"),
        (["short.jsonl", "short.jsonl"], "short.jsonl is named twice"),
        (["."], "smoothness: . holds no meta/info.json, so it is no LeRobotDataset"),
        (["--dataset.root=absent"], "--dataset.root=absent holds no meta/info.json"),
    ],
)
def test_bad_input_is_one_line(
    flags: list[str],
    message: str,
    pusht_dataset: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    append_episode(Path("short.jsonl"), "pusht", 0, 1, 10, np.zeros((3, 2)))
    append_episode(Path("three.jsonl"), "pusht", 0, 1, 10, np.zeros((5, 3)))
    usual = [f"--dataset.repo_id={REPO_ID}", f"--dataset.root={pusht_dataset}"]
    assert main(["results", "smoothness", *usual, *flags]) == 1
    error = capsys.readouterr().err
    assert error.startswith("lerobot-bomb results smoothness: ") and error.count("\n") == 1
    with pytest.raises(ValueError, match=message):
        raise ValueError(error)


def test_an_unknown_flag_names_the_commands_own_help(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["results", "smoothness", f"--dataset.repo_id={REPO_ID}", "--per_seconds_"])
    error = capsys.readouterr().err
    assert error.startswith("lerobot-bomb results smoothness: unrecognized arguments: --per_seconds_; ")
    assert error.endswith("(`lerobot-bomb results smoothness --help` lists all flags)\n")


def test_a_dim_that_never_changes_has_no_unit() -> None:
    log = executed("a", np.hstack([PARABOLA, np.ones((5, 1)), PARABOLA]))
    with pytest.raises(ValueError, match=r"'y' never changes.*leave it out with --exclude=Gripper.pos,y"):
        make_units(log, NAMES, None, False)
