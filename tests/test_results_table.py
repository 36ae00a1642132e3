"""``lerobot-bomb results``: its one table, the list of failures, and the commands that it names next."""

import json
from pathlib import Path
from typing import Any

import pytest
from bomb_pusht_cases import pusht_row
from result_rows import ACT, FDVLA, row, values

from lerobot_bomb.commands.main import main
from lerobot_bomb.results.origin import PolicyIdentity

type Printed = pytest.CaptureFixture[str]

LEGEND = [
    "success: with 95 % Wilson interval; change: points, with 95 % interval, from the same episodes",
    "unperturbed; p: exact McNemar test; where interval and p disagree, trust p; with several tasks of one",
    "seed, trust the interval, which counts a seed once",
]


@pytest.fixture
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return Path("r.jsonl")


def said(capsys: Printed, *words: str | Path) -> list[str]:
    assert main(["results", *map(str, words)]) == 0
    return capsys.readouterr().out.splitlines()


def rows(outcomes: dict[str, str], **other: Any) -> str:
    """A line for each mark of {condition: marks by seed}; all but '+' fail."""
    classes = {"d": "dropped", "i": "imprecise", "w": "wrong_intersection", "n": "never_reached"}
    return "".join(
        row(seed, classes.get(mark), spec={"perturbations": condition} | other.pop("spec", {}), **other)
        for condition, marks in outcomes.items()
        for seed, mark in enumerate(marks)
    )


def test_all_policies_and_conditions_are_one_table(path: Path, capsys: Printed) -> None:
    path.write_text(rows({"none": "++++++", "camera:3": "dddddd", "light:3": "+++++d"}))
    path.write_text(path.read_text() + rows({"none": "++++++"}, policy=FDVLA))
    assert said(capsys, path) == [
        "policy  suite  condition                success                  change  p (Holm)  n",
        "act     place  none       100.0 % [61.0, 100.0]                                    6",
        "act     place  camera:3       0.0 % [0.0, 39.0]  -100.0 [-100.0, -44.8]     0.062  6",
        "act     place  light:3      83.3 % [43.6, 97.0]    -16.7 [-56.4, +24.7]         1  6",
        "fdvla   place  none       100.0 % [61.0, 100.0]                                    6",
        "",
        *LEGEND,
        "",
        "next:",
        "  lerobot-bomb results r.jsonl --failures  # 7 failures, each with the command that replays it",
        "  lerobot-bomb compare r.jsonl             # both policies on the same episodes",
        "  lerobot-bomb report r.jsonl              # figures, failures and settings as one page",
    ]


def test_p_values_are_adjusted_over_all_suites(path: Path, capsys: Printed, tmp_path: Path) -> None:
    for suite in ("place", "object", "spatial"):
        with path.open("a") as file:
            for condition, failure in (("none", None), ("camera:3", "dropped")):
                spec = {"perturbations": condition, "suite": suite}
                file.write("".join(row(seed, failure, spec=spec, target=None) for seed in range(6)))
    lines = said(capsys, path, "--verbose")
    assert [line.split()[-2] for line in lines if " camera:3 " in line] == ["0.094"] * 3
    assert (
        sum("p = 0.094 (exact McNemar test, adjusted for 3 conditions (Holm))" in line for line in lines) == 3
    )
    assert main(["report", str(path), "--output=r.html"]) == 0
    tables = json.loads(Path("r.json").read_text())[0]["charts"][0]["tables"]
    p_values = [row[-1] for table in tables for row in table["rows"] if row[0] == "camera:3"]
    assert p_values == [pytest.approx(3 * 2 / 2**6)] * 3


def test_several_files_are_one_table_and_a_policy_has_one_name_in_it(path: Path, capsys: Printed) -> None:
    other = PolicyIdentity("act", "outputs/other", None, "e" * 64, "b" * 64)
    path.write_text(rows({"none": "++"}))
    Path("s.jsonl").write_text(rows({"none": "+"}, policy=other) + rows({"none": "+"}, policy=ACT))
    table = said(capsys, path, "s.jsonl")[:4]
    assert [line.split()[:4] for line in table[1:]] == [
        ["r.jsonl", "act", "act", "place"],
        ["s.jsonl", "act", "other", "place"],
        ["s.jsonl", "act", "act", "place"],
    ]
    assert table[0].split()[:3] == ["file", "policy", "suite"]


@pytest.mark.parametrize(
    ("first", "second", "is_named"),
    [
        (row(0), row(0, policy=FDVLA), True),
        (row(0) + row(0, policy=FDVLA), row(1), False),  # compare takes one policy from each of two files
        (row(0), row(0, policy=FDVLA, image_size=64), False),
        (row(0), row(1), False),
        (row(0), rows({"camera:3": "+"}, policy=FDVLA), False),  # the other condition: no pair
    ],
)
def test_a_comparison_is_named_where_there_is_one(
    first: str, second: str, is_named: bool, path: Path, capsys: Printed
) -> None:
    path.write_text(first)
    Path("s.jsonl").write_text(second)
    named = [line for line in said(capsys, path, "s.jsonl") if "lerobot-bomb compare r.jsonl s.jsonl" in line]
    assert len(named) == is_named


def test_what_is_kept_apart_is_a_column(path: Path, capsys: Printed) -> None:
    path.write_text(row(0) + row(1, image_size=64) + row(2, "dropped", image_size=64))
    first, *table = said(capsys, path)[:3]
    assert first.split()[:4] == ["policy", "suite", "image_size", "condition"]
    assert [line.split()[2:5] for line in table] == [["256", "none", "100.0"], ["64", "none", "50.0"]]
    told = "r.jsonl: episodes that differ in image_size are neither pooled nor paired"
    assert told in said(capsys, path)
    suites = [row(0), row(0, spec={"suite": "object"}, task_version="1.1")]
    path.write_text("".join(suites))
    lines = said(capsys, path)
    assert "task_version" not in "\n".join(lines) and not any("neither pooled" in line for line in lines)


def test_what_is_missing_or_damaged_stands_below_the_table(path: Path, capsys: Printed) -> None:
    path.write_text(row(0) + rows({"all:3": "+d"}) + '{"spec": {"se\n')
    assert main(["results", str(path)]) == 0
    printed = capsys.readouterr()
    below = printed.out.splitlines()[7:9]
    assert below == [
        "r.jsonl: damaged records, which are not counted: 1",
        "r.jsonl: act, place: perturbed episodes without an unperturbed one to compare with: 1; add "
        '"none" to --env.perturbations',
    ]
    assert "r.jsonl:4: not an episode result" in printed.err


def test_what_a_name_of_5000_characters_leaves_of_the_table(path: Path, capsys: Printed) -> None:
    names = [PolicyIdentity(kind * 5000) for kind in "xy"]
    path.write_text("".join(row(0, policy=name) for name in names))
    table = said(capsys, path)[:3]
    assert max(map(len, table)) < 110
    assert [line.split()[0] for line in table[1:]] == [f"{kind * 18}…{kind * 17}" for kind in "xy"]


def test_without_a_perturbation_there_is_no_change(path: Path, capsys: Printed) -> None:
    path.write_text(row(0))
    assert said(capsys, path)[:2] == [
        "policy  suite  condition                success  change  p (Holm)  n",
        "act     place  none       100.0 % [20.7, 100.0]                    1",
    ]
    assert said(capsys, path)[-2:] == [
        "next:",
        "  lerobot-bomb report r.jsonl  # figures, failures and settings as one page",
    ]
    assert said(capsys, path, "--failures") == ["no failure in 1 episode"]


def test_failures_are_listed_by_condition_class_and_seed(path: Path, capsys: Printed) -> None:
    path.write_text(rows({"none": "w+", "camera:3": "wnwid"}) + row(1, "imprecise", 14.26))
    assert said(capsys, path, "--failures") == [
        "line  seed  condition  failure               error  replay",
        "8        1  none       imprecise           14.3 mm  lerobot-bomb replay r.jsonl --line=8",
        "1        0  none       wrong_intersection  40.0 mm  lerobot-bomb replay r.jsonl --line=1",
        "7        4  camera:3   dropped                      lerobot-bomb replay r.jsonl --line=7",
        "6        3  camera:3   imprecise            1.0 mm  lerobot-bomb replay r.jsonl --line=6",
        "4        1  camera:3   never_reached                lerobot-bomb replay r.jsonl --line=4",
        "3        0  camera:3   wrong_intersection  40.0 mm  lerobot-bomb replay r.jsonl --line=3",
        "5        2  camera:3   wrong_intersection  40.0 mm  lerobot-bomb replay r.jsonl --line=5",
        "",
        "next:",
        "  lerobot-bomb explain --results=r.jsonl --line=8  # what the actions of the first depend on",
    ]


def test_failures_of_several_policies_suites_and_files_say_whose_they_are(
    path: Path, capsys: Printed
) -> None:
    path.write_text(row(0, "dropped"))
    second = Path("a b.jsonl")
    spec = {"suite": "object"}
    second.write_text(row(3, "dropped", policy=FDVLA, spec=spec, task_version="1.1"))
    header, *lines = said(capsys, path, second, "--failures")[:3]
    assert header.split() == ["line", "seed", "policy", "suite", "condition", "failure", "replay"]
    assert [line.split()[1:4] for line in lines] == [["0", "act", "place"], ["3", "fdvla", "object"]]
    assert lines[1].endswith("lerobot-bomb replay 'a b.jsonl' --line=1")


def test_an_environment_without_millimetres_has_no_errors(path: Path, capsys: Printed) -> None:
    path.write_text(json.dumps(pusht_row(3, "none", 0.5, "timeout")) + "\n")
    assert said(capsys, path, "--failures")[:2] == [
        "line  seed  condition  failure  replay",
        "1        3  none       timeout  lerobot-bomb replay r.jsonl --line=1",
    ]


def test_an_episode_that_was_run_again_is_listed_as_it_ended_last(path: Path, capsys: Printed) -> None:
    path.write_text(row(0, "dropped") + row(1, "dropped") + row(0))
    lines = said(capsys, path, "--failures")
    assert [line.split()[0] for line in lines[1:2]] == ["2"] and lines[2] == ""


def test_failures_and_details_exclude_each_other(path: Path, capsys: Printed) -> None:
    path.write_text(row(0))
    with pytest.raises(SystemExit):
        main(["results", str(path), "--failures", "--verbose"])
    assert "not allowed with argument" in capsys.readouterr().err


def test_strict_refuses_before_anything_is_printed(path: Path, capsys: Printed) -> None:
    path.write_text(row(0))
    Path("damaged.jsonl").write_text(row(0) + "nonsense\n")
    assert main(["results", str(path), "damaged.jsonl", "--strict"]) == 1
    printed = capsys.readouterr()
    assert printed.out == "" and "damaged records, which --strict refuses: 1" in printed.err


def test_a_file_of_many_conditions_is_read(path: Path, capsys: Printed) -> None:
    axes = ("camera", "light", "table", "stones", "start")
    conditions = [
        f"{a}:{i}+{b}:{j}" for a in axes[:2] for b in axes[2:] for i in range(1, 6) for j in range(1, 6)
    ]
    specs = [{"perturbations": condition} for condition in ("none", *conditions)]
    path.write_text("".join(json.dumps(values(0, spec=spec)) + "\n" for spec in specs))
    assert len([line for line in said(capsys, path) if line.startswith("act")]) == 151
