"""``lerobot-bomb report``: every number equals a recount from the lines."""

import csv
import json
import shlex
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from result_rows import FDVLA, read, values
from scipy.stats import linregress

from lerobot_bomb.commands.main import main
from lerobot_bomb.report.cells import points
from lerobot_bomb.report.sections.run import commands
from lerobot_bomb.results.groups import groups_of
from lerobot_bomb.results.pairs import compare_pairs

CLASSES = (None, None, None, "imprecise", "wrong_intersection", "dropped")
LEVELS = "Success over the levels of an axis"
type Printed = pytest.CaptureFixture[str]
type Rows = list[dict[str, Any]]


@pytest.fixture(scope="module")
def rows() -> Rows:
    """Make rows of two policies, three conditions, 12 seeds, and outcomes that differ."""
    made = []
    for place, policy in enumerate((None, FDVLA)):
        for number, condition in enumerate(("none", "camera:2", "camera:4")):
            for seed in range(12):
                failure = CLASSES[(seed * (number + 1) + place * number) % len(CLASSES)]
                other = {} if policy is None else {"policy": policy}
                error = seed / 2 + (40.0 if failure == "wrong_intersection" else 1.0)
                at = {"target": [seed % 5, seed % 3], "spec": {"perturbations": condition}}
                at |= {"nearest_intersection": [0, 4]} if failure == "wrong_intersection" else {}
                made.append(values(seed, failure, error, **at, **other))
    return made


@pytest.fixture(scope="module")
def written(rows: Rows, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a report of these rows, in two files."""
    tmp_path = tmp_path_factory.mktemp("written")
    for number in range(2):
        part = [row for row in rows if (row["policy"]["type"] == "fdvla") == number]
        (tmp_path / f"{number}.jsonl").write_text("".join(json.dumps(row) + "\n" for row in part))
    files = [str(tmp_path / f"{number}.jsonl") for number in range(2)]
    assert main(["report", *files, f"--output={tmp_path / 'out' / 'r.html'}", "--title=<A & B>"]) == 0
    return tmp_path / "out"


def tables(folder: Path, section: str) -> list[dict[str, Any]]:
    """Return the tables of a section, those of its charts first."""
    found = [each for each in json.loads((folder / "r.json").read_text()) if each["title"] == section]
    return [table for each in found for holder in [*each["charts"], each] for table in holder["tables"]]


def recount(rows: Rows, policy: str, condition: str) -> Rows:
    return [r for r in rows if r["policy"]["type"] == policy and r["spec"]["perturbations"] == condition]


def test_rates_and_costs_are_those_of_the_lines(rows: Rows, written: Path) -> None:
    _, *found, axes = tables(written, "Success")
    assert [table["title"] for table in found] == ["act, place", "fdvla, place"]
    assert [row[0] for row in axes["rows"]] == ["camera"]
    for table, policy in zip(found, ("act", "fdvla"), strict=True):
        assert [row[0] for row in table["rows"]] == ["none", "camera:2", "camera:4"]
        nominal = {row["spec"]["seed"]: row["is_success"] for row in recount(rows, policy, "none")}
        for condition, success, n, *cost in table["rows"]:
            episodes = recount(rows, policy, condition)
            assert (success["successes"], success["n"], n) == (sum(r["is_success"] for r in episodes), 12, 12)
            if condition != "none":
                lost = sum(nominal[r["spec"]["seed"]] and not r["is_success"] for r in episodes)
                won = sum(r["is_success"] and not nominal[r["spec"]["seed"]] for r in episodes)
                assert (cost[0]["only_first"], cost[0]["only_second"]) == (lost, won)
                assert cost[0]["difference"] == pytest.approx((won - lost) / 12)
    with (written / "r.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 6 and {line["n"] for line in lines} == {"12"}
    assert sum(int(line["successes"]) for line in lines) == sum(row["is_success"] for row in rows)


def test_the_classes_that_occur_are_explained(written: Path) -> None:
    page = (written / "r.html").read_text()
    assert "wrong_intersection: put down nearest to another intersection." in page
    assert "never_reached: " not in page


def test_failures_levels_and_the_board_are_those_of_the_lines(rows: Rows, written: Path) -> None:
    bars, *by_condition = tables(written, "Why episodes failed")
    for bar, *cells in bars["rows"]:
        policy, kind = bar.split(", ")
        episodes = [row for row in rows if row["policy"]["type"] == policy]
        episodes = [r for r in episodes if (r["spec"]["perturbations"] == "none") == (kind == "unperturbed")]
        classes = Counter(row["failure"] or "success" for row in episodes)
        counts = dict(zip(bars["header"][1:], cells, strict=True))
        assert counts == {name: classes[name] for name in bars["header"][2:]} | {"episodes": len(episodes)}
    assert len(bars["rows"]) == 4
    for table, policy in zip(by_condition, ("act", "fdvla"), strict=True):
        names = table["header"][2:-2]
        for condition, _, *counts, right, there in table["rows"]:
            episodes = recount(rows, policy, condition)
            classes = Counter(row["failure"] for row in episodes)
            assert dict(zip(names, counts, strict=True)) == {name: classes[name] for name in names}
            put_down = [
                row for row in episodes if row["failure"] in (None, "imprecise", "wrong_intersection")
            ]
            grounded = [row for row in put_down if row["nearest_intersection"] == row["target"]]
            assert (right["successes"], right["n"]) == (len(grounded), len(put_down))
            assert there["n"] == len(grounded)
    for table, policy in zip(tables(written, LEVELS)[:2], ("act", "fdvla"), strict=True):
        ((axis, *levels),) = table["rows"]
        assert axis == "camera" and table["header"][1:] == ["0", "2", "4"]
        expected = [
            sum(r["is_success"] for r in recount(rows, policy, c)) for c in ("none", "camera:2", "camera:4")
        ]
        assert [level["successes"] for level in levels] == expected


def test_the_board_is_that_of_the_lines(rows: Rows, written: Path) -> None:
    named, missed = tables(written, "The board")
    for policy, row, column, success in named["rows"]:
        episodes = [r for r in rows if r["policy"]["type"] == policy and r["target"] == [row, column]]
        counted = sum(r["is_success"] for r in episodes)
        assert (success["successes"], success["n"]) == (counted, len(episodes))
    assert sum(each[3]["n"] for each in named["rows"]) == len(rows)
    expected = Counter(
        (row["policy"]["type"], *row["target"], *row["nearest_intersection"])
        for row in rows
        if row["failure"] == "wrong_intersection" and row["target"] != [0, 4]
    )
    assert {tuple(row[:5]): row[5] for row in missed["rows"]} == expected


def test_the_distribution_of_errors_is_that_of_the_lines(rows: Rows, written: Path) -> None:
    (table,) = tables(written, "Placement error")
    for name, number, *percentiles in table["rows"]:
        policy, kind = name.split(", ")
        errors = sorted(
            row["placement_error_mm"]
            for row in rows
            if row["policy"]["type"] == policy
            and (row["spec"]["perturbations"] == "none") == (kind == "unperturbed")
            and row["failure"] in (None, "imprecise", "wrong_intersection")
        )
        assert (number, percentiles[0], percentiles[-1]) == (len(errors), errors[0], errors[-1])
        assert percentiles[10] == errors[-(-len(errors) // 2) - 1]  # the median, an error of the lines
    assert len(table["rows"]) == 4


def test_the_map_is_that_of_the_lines(rows: Rows, written: Path) -> None:
    (table,) = tables(written, "Every policy under every condition")
    names = ["none" if name == "unperturbed" else name for name in table["header"][1:]]
    assert sorted(names) == ["camera:2", "camera:4", "none"] and names[0] == "none"
    for policy, *shares in table["rows"]:
        for condition, share in zip(names, shares, strict=True):
            episodes = recount(rows, policy, condition)
            assert share == sum(row["is_success"] for row in episodes) / 12


def test_two_policies_are_compared_on_their_common_episodes(rows: Rows, written: Path) -> None:
    (table,) = tables(written, "Two policies on the same episodes")
    for condition, first, second, difference, _, pairs in table["rows"]:
        a, b = recount(rows, "act", condition), recount(rows, "fdvla", condition)
        assert pairs == 12
        assert first["successes"] == sum(row["is_success"] for row in a)
        assert second["successes"] == sum(row["is_success"] for row in b)
        assert difference["both"] == sum(
            x["is_success"] and y["is_success"] for x, y in zip(a, b, strict=True)
        )


def test_every_command_has_the_same_p_value_for_the_same_pairs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lost = {"none": 0, "camera:3": 6, "light:3": 0}
    rows = [
        values(seed, "dropped" if seed < number else None, spec={"perturbations": condition, "suite": suite})
        for suite in ("place", "object")
        for condition, number in lost.items()
        for seed in range(6)
    ]
    others = [
        values(seed, spec={"perturbations": condition, "suite": suite}, policy=FDVLA)
        for suite in ("place", "object")
        for condition in lost
        for seed in range(6)
    ]
    path = tmp_path / "all.jsonl"
    path.write_text("".join(json.dumps(row) + "\n" for row in [*rows, *others]))
    assert main(["report", str(path), f"--output={tmp_path / 'r.html'}"]) == 0
    answers, _, paths = capsys.readouterr().out.partition("\n\n")
    statements = json.loads((tmp_path / "r.json").read_text())[0]["statements"]
    assert answers.splitlines() == statements and len(statements) > 2
    assert paths.splitlines() == [str(tmp_path / f"r.{suffix}") for suffix in ("html", "json", "csv")]
    assert main(["results", str(path), "--verbose"]) == 0
    said = capsys.readouterr().out
    # 2 / 2^6 of one pair of conditions; a policy's conditions of both suites are one family
    assert said.count("camera:3: 6 pairs, 6 lost, 0 won, p = 0.12 (exact McNemar test, adjusted for 4") == 2
    _, act, *_ = tables(tmp_path, "Success")
    assert {row[0]: row[4] for row in act["rows"]} == {"none": "", "camera:3": 4 * 2 / 2**6, "light:3": 1.0}
    assert "p: exact McNemar test, adjusted for 4 conditions (Holm)." in act["note"]
    # two policies: all six conditions of both suites are one family, in `compare` and on the page alike
    assert main(["compare", str(path)]) == 0
    said = capsys.readouterr().out
    assert said.count("B alone in 6 of 6 pairs, p = 0.19\n") == 2
    assert "adjusted for 6 conditions (Holm)" in said
    (table,) = tables(tmp_path, "Two policies on the same episodes")
    assert {row[0]: row[4] for row in table["rows"]}["object, camera:3"] == 6 * 2 / 2**6
    assert "adjusted for 6 conditions (Holm)" in table["note"]


def test_the_page_is_whole_and_asks_nobody_for_anything(written: Path) -> None:
    text = (written / "r.html").read_text()
    opened: list[str] = []

    class Reader(HTMLParser):
        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            opened.append(tag)
            assert all(name not in ("src", "onclick") for name, _ in attrs)

        def handle_endtag(self, tag: str) -> None:
            while opened.pop() != tag:
                pass

    Reader().feed(text)
    assert opened == ["!doctype"][1:] and "<script" not in text and "http" not in text
    assert "<title>&lt;A &amp; B&gt;</title>" in text and "prefers" not in text
    assert "color-scheme:light dark" in text and 'name="viewport"' in text


def test_without_an_episode_there_is_no_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty.jsonl").write_text("")
    assert main(["report", str(tmp_path / "empty.jsonl"), f"--output={tmp_path / 'r.html'}"]) == 1
    assert "no finished episode" in capsys.readouterr().err
    assert not (tmp_path / "r.html").exists()


def test_axes_are_ranked_by_what_a_level_costs(rows: Rows, written: Path) -> None:
    for table, policy in zip(tables(written, LEVELS)[2:], ("act", "fdvla"), strict=True):
        ((axis, found, share),) = table["rows"]
        episodes = [row for row in rows if row["policy"]["type"] == policy]
        levels = [row["levels"].get("camera", 0) for row in episodes]
        expected = linregress(levels, [float(row["is_success"]) for row in episodes])[0]
        assert (axis, share) == ("camera", "") and found["per_level"] == pytest.approx(expected)


def test_what_an_axis_explains_is_counted_where_levels_were_drawn(rows: Rows, tmp_path: Path) -> None:
    drawn = []
    for seed in range(30):
        camera, light = 1 + seed % 5, 1 + seed // 5 % 5
        failure = None if camera < 3 else "imprecise"
        line = values(seed, failure, 1.0, spec={"perturbations": "camera:1-5+light:1-5"})
        drawn.append(line | {"levels": {"camera": camera, "light": light}})
    (tmp_path / "d.jsonl").write_text("".join(json.dumps(row) + "\n" for row in drawn))
    assert main(["report", str(tmp_path / "d.jsonl"), f"--output={tmp_path / 'r.html'}"]) == 0
    (table,) = tables(tmp_path, LEVELS)
    shares = {axis: share for axis, _, share in table["rows"]}
    assert list(shares) == ["camera", "light"]
    assert shares["camera"] == pytest.approx(1.0) and shares["light"] < 0.05


@pytest.mark.parametrize("name", ["data.json", "data.csv"])
def test_a_file_of_results_is_never_replaced(
    name: str, rows: Rows, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / name
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    before = path.read_bytes()
    assert main(["report", str(path), f"--output={tmp_path / 'data.html'}"]) == 1
    assert f"{path} is a file of results that is read" in capsys.readouterr().err
    assert path.read_bytes() == before and [each.name for each in tmp_path.iterdir()] == [name]


def test_the_output_is_a_page_or_a_folder(
    rows: Rows, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "r.jsonl"
    path.write_text(json.dumps(rows[0]) + "\n")
    assert main(["report", str(path), f"--output={tmp_path / 'page.txt'}"]) == 1
    assert "must be the page's path, .html, or a folder" in capsys.readouterr().err
    (tmp_path / "out").mkdir()
    assert main(["report", str(path), f"--output={tmp_path / 'out'}"]) == 0
    assert (tmp_path / "out" / "report.html").is_file()


def test_points_as_numbers() -> None:
    (compared,) = compare_pairs(
        {"none": [(read(values(seed, "dropped")), read(values(seed))) for seed in range(6)]}
    )
    difference, p_value = points(compared)
    assert compared.interval is not None
    low, high = compared.interval
    counts = {"both": 0, "only_first": 0, "only_second": 6, "neither": 0}
    assert difference.value == {"difference": 1, "low": low, "high": high, **counts}
    assert p_value.value == pytest.approx(2 / 2**6)


def test_the_page_says_how_many_lines_are_damaged(rows: Rows, tmp_path: Path) -> None:
    path = tmp_path / "r.jsonl"
    path.write_text("".join(json.dumps(row) + "\n" for row in rows) + "rubbish\n{}\n")
    assert main(["report", str(path), f"--output={tmp_path / 'page.html'}"]) == 0
    assert f"{path}: 2 damaged records are not counted" in (tmp_path / "page.html").read_text()


@pytest.mark.parametrize("command", ["report", "export"])
def test_unknown_policies_of_two_files_are_refused(command: str, tmp_path: Path, capsys: Printed) -> None:
    x, y = (tmp_path / "x.jsonl", tmp_path / "y.jsonl")
    for path, failure in ((x, None), (y, "dropped")):
        path.write_text(json.dumps(values(0, failure, policy=None)) + "\n")
    output = f"--output={tmp_path / 'out'}"
    assert main([command, str(x), str(y), output]) == 1
    assert f"the records of {x} and {y} name no policy" in capsys.readouterr().err
    assert main([command, str(x), output]) == 0
    assert main(["compare", str(x), str(y)]) == 0
    assert "the same policy" not in capsys.readouterr().out


@pytest.mark.parametrize("command", ["report", "export"])
def test_replaced_records_are_counted(command: str, rows: Rows, tmp_path: Path, capsys: Printed) -> None:
    path = tmp_path / "r.jsonl"
    path.write_text((json.dumps(rows[0]) + "\n") * 3)
    assert main([command, str(path), f"--output={tmp_path / 'out'}"]) == 0
    told = "act, place: 2 records are replaced by later ones of the same episode"
    assert told in capsys.readouterr().err
    assert command == "export" or told in (tmp_path / "out.html").read_text()


def test_the_command_that_is_given_runs_the_same_again(rows: Rows, written: Path) -> None:
    (section,) = [
        each for each in json.loads((written / "r.json").read_text()) if each["title"] == "What was run"
    ]
    commands = [line for line in section["lines"] if "lerobot-eval" in line]
    assert len(commands) == 2
    for command in commands:
        flags = dict(flag.split("=", 1) for flag in shlex.split(command)[1:])
        assert flags["--seed"] == "0" and flags["--eval.n_episodes"] == "12"
        assert json.loads(flags["--env.perturbations"]) == ["none", "camera:2", "camera:4"]
        assert any(name in flags for name in ("--policy.path", "--policy.type"))


def test_its_number_of_episodes_is_per_task() -> None:
    rows = [
        values(seed, spec={"suite": "object", "task_id": task_id}) for task_id in (0, 3) for seed in range(3)
    ]
    (group,) = groups_of(map(read, rows))
    assert "--eval.n_episodes=3" in shlex.split(commands(group)[-1])
