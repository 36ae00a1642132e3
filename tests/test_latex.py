"""Tables for a paper: what they say is what the records say, and LaTeX can read them."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
from bomb_pusht_cases import pusht_row
from result_rows import FDVLA, read, row, values

from lerobot_bomb.commands.main import main
from lerobot_bomb.report.latex import MAX_BESIDE, SPECIAL, latex_tables
from lerobot_bomb.results.groups import groups_of
from lerobot_bomb.results.origin import PolicyIdentity
from lerobot_bomb.results.reading import parse_record


def write(path: Path, failures: dict[str, int], n: int, **other: Any) -> Path:
    """Append n lines of each condition; the first of them fail."""
    with path.open("a") as file:
        for condition, number in failures.items():
            for seed in range(n):
                failure = "dropped" if seed < number else None
                file.write(row(seed, failure, spec={"perturbations": condition}, **other))
    return path


def tables(path: Path) -> str:
    """Return the tables of a file's records."""
    records = [parse_record(line) for line in path.read_bytes().splitlines()]
    return latex_tables(groups_of(records))


def body(text: str) -> list[list[str]]:
    """Return the cells of each line of one table; check what LaTeX would stop at."""
    text = re.sub(r"(?<!\\)%.*", "", text)
    assert set(re.findall(r"\\([A-Za-z]+)", text)) <= {
        "begin", "end", "centering", "caption", "label", "footnotesize", "toprule", "midrule", "bottomrule",
        "multicolumn", "cmidrule", "addlinespace", "textbf",
        *(command.strip("\\{}") for command in SPECIAL.values() if command[1].isalpha()),
    }  # fmt: skip
    bare = re.sub(r"\\[\\_%&#${}]", "", text)
    depth = 0
    for character in bare:
        depth += {"{": 1, "}": -1}.get(character, 0)
        assert depth >= 0
    assert depth == 0 and bare.count("$") % 2 == 0
    opened: list[str] = []
    for word, name in re.findall(r"\\(begin|end)\{(\w+)\}", text):
        if word == "begin":
            opened.append(name)
        else:
            assert opened.pop() == name
    assert opened == []
    (alignment,) = re.findall(r"\\begin\{tabular\}\{(\w+)\}", text)
    lines = [line.removesuffix(r" \\") for line in text.splitlines() if line.endswith(r"\\")]
    cells = [
        re.split(r"(?<!\\) & ", line)
        if not line.startswith(" & ")
        else ["", *re.split(r"(?<!\\) & ", line[3:])]
        for line in lines
    ]
    for line in cells:
        spans = [
            int(found[1]) if (found := re.match(r"\\multicolumn\{(\d+)\}", cell)) else 1 for cell in line
        ]
        assert sum(spans) == len(alignment)
    return cells


def test_conditions_stand_beside_policies_with_rate_change_and_p(tmp_path: Path) -> None:
    path = write(tmp_path / "r.jsonl", {"none": 2, "all:1-5": 7}, 10)
    write(path, {"none": 1, "all:1-5": 10}, 10, policy=FDVLA)
    text = tables(path)
    assert body(text) == [
        ["", r"\multicolumn{3}{c}{act}", r"\multicolumn{3}{c}{fdvla}"],
        ["condition", *["success", "change", "$p$"] * 2],
        ["none", "80.0 [49.0, 94.3]", "--", "--", "90.0 [59.6, 98.2]", "--", "--"],
        ["all:1-5", "30.0 [10.8, 60.3]", "$-50.0$", "0.062", "0.0 [0.0, 27.8]", "$-90.0$", "0.0039"],
    ]
    (caption,) = re.findall(r"\\caption\{(.*)\}", text)
    assert caption == (
        r"Success in \% on BOMB, task version 1.0, suite place: 10 episodes each, seeds 0--9, with 95 \% "
        "Wilson intervals, clustered by seed. Change: in points, from the same episodes unperturbed; $p$: "
        "exact McNemar test of one condition, not adjusted. Under no condition is a policy shown to be "
        "better than every other one ($p < 0.05$, exact McNemar test on the same episodes, adjusted for "
        "conditions (Holm)). "
        "MuJoCo 3.8.1."
    )
    assert r"\label{tab:bomb-place}" in text


def test_the_best_is_bold_where_it_is_shown_to_be_better_than_every_other(tmp_path: Path) -> None:
    third = PolicyIdentity("third", None)
    path = tmp_path / "r.jsonl"
    for policy, failures in {
        # failures of 20: 0 against 12 and 14 is shown, 0 against 5 is not, 20 against 20 is a tie
        FDVLA: {"none": 0, "light:3": 0, "camera:3": 20},
        PolicyIdentity("act"): {"none": 12, "light:3": 5, "camera:3": 20},
        third: {"none": 14, "light:3": 20, "camera:3": 20},
    }.items():
        write(path, failures, 20, policy=policy)
    text = tables(path)
    rates = {line[0]: line[1::3] for line in body(text)[2:]}
    assert rates["none"][0] == r"\textbf{100.0 [83.9, 100.0]}"
    assert text.count(r"\textbf") == 1 and "Bold: better than every other one ($p < 0.05$" in text


def test_a_condition_that_only_one_policy_has_is_not_bold(tmp_path: Path) -> None:
    path = write(tmp_path / "r.jsonl", {"none": 0, "light:3": 0}, 20)
    write(path, {"none": 20}, 20, policy=FDVLA)
    text = tables(path)
    assert body(text)[-1] == ["light:3", "100.0 [83.9, 100.0]", "$+0.0$", "1", "--", "--", "--"]
    assert text.count(r"\textbf") == 1


def test_many_policies_stand_below_each_other(tmp_path: Path) -> None:
    path = tmp_path / "r.jsonl"
    for number in range(MAX_BESIDE + 1):
        policy = PolicyIdentity("act", f"runs/{number}", weights_sha256=str(number) * 64)
        write(path, {"none": 0, "light:3": number}, 4, policy=policy)
    header, *lines = body(tables(path))
    assert header == ["condition", "policy", "success", "change", "$p$"]
    assert [line[:2] for line in lines] == [
        [condition if number == 0 else "", f"act {number}"]
        for condition in ("none", "light:3")
        for number in range(4)
    ]


def test_suites_and_settings_are_tables_of_their_own(tmp_path: Path) -> None:
    path = write(tmp_path / "r.jsonl", {"none": 0}, 3)
    write(path, {"none": 1}, 3, image_size=64)
    write(path, {"none": 1}, 3, policy=FDVLA)
    with path.open("a") as file:
        file.write(row(0, spec={"suite": "object"}, task_version="1.1"))
        file.write(json.dumps(pusht_row(0, "none", 0.5, "timeout")) + "\n")
    first = tables(path)
    found = re.findall(r"\\begin\{table\}.*?\\end\{table\}", first, flags=re.DOTALL)
    assert [body(text)[0][1:] for text in found] == [
        ["act", "fdvla"], ["act"], ["act"], ["policy not recorded"]
    ]  # fmt: skip
    labels = [*re.findall(r"tab:([\w-]+)", first)]
    assert labels == ["bomb-place", "bomb-place-2", "bomb-object", "bomb_pusht"]
    assert r"image\_size: 256." in found[0] and r"image\_size: 64." in found[1]
    assert "task version 1.1, suite object: 1 episode each" in found[2]
    assert "PushT with BOMB's axes" in found[3] and "gym-pusht" in found[3]


HOSTILE = [
    "a_b%c&d#e$f{g}h~i^j\\k<l>m|n",
    "[x] & y \\\\",
    "\x1b]0;owned\x07\n\\end{table}",
    "x" * 5000,
    "é → 中",
]


@pytest.mark.parametrize("name", HOSTILE)
def test_whatever_a_policy_is_called_latex_can_read_it(name: str, tmp_path: Path) -> None:
    path = write(tmp_path / "r.jsonl", {"none": 0, "light:3": 2}, 3, policy=PolicyIdentity(name))
    others = write(tmp_path / "o.jsonl", {"none": 2, "light:3": 2}, 3, policy=FDVLA)
    assert main(["compare", str(path), str(others), f"--output={tmp_path / 'c.tex'}"]) == 0
    body((tmp_path / "c.tex").read_text())
    path.write_text(path.read_text() + others.read_text())
    text = tables(path)
    body(text)
    assert len(text) < 3000 and "\x1b" not in text
    assert set("_%&#${}~^\\<>|") == set(SPECIAL)


def test_a_comparison_is_a_table_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a = write(tmp_path / "a.jsonl", {"none": 1, "light:3": 20}, 20)
    b = write(tmp_path / "b.jsonl", {"none": 0, "light:3": 4}, 20, policy=FDVLA)
    flags = [str(a), str(b), f"--output={tmp_path / 'c.tex'}", "--names=act=Ours"]
    assert main(["compare", *flags]) == 0
    assert capsys.readouterr().out.splitlines()[0] == "A is Ours, B is fdvla"
    text = (tmp_path / "c.tex").read_text()
    assert body(text) == [
        ["condition", "A", "B", "B $-$ A", "$p$", "pairs"],
        ["none", "95.0 [76.4, 99.1]", "100.0 [83.9, 100.0]", "$+5.0$ [$-11.6$, $+23.6$]", "1", "20"],
        [
            "light:3", "0.0 [0.0, 16.1]", r"\textbf{80.0 [58.4, 91.9]}", "$+80.0$ [$+53.1$, $+91.9$]",
            "$<$ 0.001", "20",
        ],
    ]  # fmt: skip
    assert (
        r"Success in \% of Ours (A) and fdvla (B) on BOMB, task version 1.0, suite place: 20 episodes" in text
    )
    assert (
        "$p$: exact McNemar test, adjusted for 2 conditions (Holm). Bold: better, $p < 0.05$. MuJoCo 3.8.1."
        in text
    )


@pytest.mark.parametrize(
    ("output", "message"),
    [("c.txt", "c.txt must be a file of LaTeX, .tex"), ("a.tex", "a.tex is a file of results that is read")],
)
def test_an_output_that_is_no_table_is_refused(
    output: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a = write(tmp_path / "a.tex", {"none": 1}, 2)
    b = write(tmp_path / "b.jsonl", {"none": 0}, 2, policy=FDVLA)
    before = a.read_text()
    assert main(["compare", str(a), str(b), f"--output={tmp_path / output}"]) == 1
    assert message in capsys.readouterr().err
    assert a.read_text() == before


def test_one_episode_has_a_table() -> None:
    text = latex_tables(groups_of([read(values(0))]))
    assert body(text)[1:] == [["none", "100.0 [20.7, 100.0]"]]
    assert "Change" not in text and "Bold" not in text
