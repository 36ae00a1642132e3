"""Sections of a report beyond its rates: efficiency, language use, failures to look at, published figures."""

import json
import shlex
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from html import escape
from html.parser import HTMLParser
from pathlib import Path
from statistics import median
from typing import Any

import av
import pytest
from result_rows import ACT, FDVLA, read, values

from lerobot_bomb.bomb.perturbations import Condition
from lerobot_bomb.checkpoints.names import REPLACE_TASKS
from lerobot_bomb.commands.main import main
from lerobot_bomb.commands.report import NUM_SAMPLES
from lerobot_bomb.environments import ENVIRONMENTS
from lerobot_bomb.report.report import Report, Sample
from lerobot_bomb.report.sections import SECTIONS, samples
from lerobot_bomb.report.sections.published import MARK, SPEED, SUCCESS
from lerobot_bomb.results.origin import PolicyIdentity

type Rows = list[dict[str, Any]]
LEVELS = "Success over the levels of an axis"
TOLD = PolicyIdentity(
    FDVLA.type,
    "audit/other_instruction",
    None,
    FDVLA.weights_sha256,
    "e" * 64,
    interventions=(REPLACE_TASKS,),
)


def inference(seed: int, **other: Any) -> dict[str, Any]:
    return {
        "num_queries": 2 + seed,
        "total_s": 0.1 * (2 + seed),
        "latency_p50_ms": 10.0 + seed,
        "latency_p95_ms": 20.0 + seed,
        "passes": float(seed),
        "tokens": None,
        "num_parameters": 1_234_567,
        "peak_memory_bytes": (seed + 1) * 2**20,
        "device": "cpu, 1 thread",
    } | other


def write(path: Path, rows: Rows) -> Path:
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


@pytest.fixture
def report(tmp_path: Path) -> Callable[..., dict[str, Any]]:
    """{title: section} of the report of rows, whose page is tmp_path / out / r.html."""

    def make(*files: Rows, flags: tuple[str, ...] = ()) -> dict[str, Any]:
        paths = [str(write(tmp_path / f"{number}.jsonl", rows)) for number, rows in enumerate(files)]
        assert main(["report", *paths, f"--output={tmp_path / 'out' / 'r.html'}", *flags]) == 0
        sections = json.loads((tmp_path / "out" / "r.json").read_text())
        return {section["title"]: section for section in sections}

    return make


def columns(table: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the table's rows by the names of their columns."""
    return [dict(zip(table["header"], row, strict=True)) for row in table["rows"]]


# Success


def perturbed(failures: Mapping[str, Sequence[str | None]], policy: PolicyIdentity = ACT) -> Rows:
    """An episode for each seed from 0 on, under each condition."""
    return [
        values(seed, failure, policy=policy, spec={"perturbations": condition})
        for condition, outcomes in failures.items()
        for seed, failure in enumerate(outcomes)
    ]


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
        "act against fdvla: unperturbed, no difference is shown: act has 50 points [-27, 91] more (2 pairs, "
        "p = 1; about 17 pairs would show this much). Under camera:3, no difference is shown: act has 50 "
        "points [-27, 91] more (2 pairs, p = 1; about 17 pairs would show this much).",
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
        "act is better under 1, most under all:3 (by 100 points) and fdvla is better under 1, most under "
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
    assert chart["title"] == "Success by policy, unperturbed and perturbed" and len(chart["tables"]) == 9
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


def test_the_efficiency_table_equals_a_recount(report: Callable[..., dict[str, Any]]) -> None:
    measured = [
        values(seed, inference=inference(seed), action_j2=0.1 * seed, action_j3=1.0) for seed in range(5)
    ]
    plain = [values(seed, policy=FDVLA) for seed in range(5)]
    table, smoothness = (each["tables"][0] for each in report([*measured, *plain])["Efficiency"]["charts"])
    (row,) = columns(table)  # nothing is shown of a policy that was not measured
    told = [each["inference"] for each in measured]
    queries = sum(each["num_queries"] for each in told)
    assert (row["device"], row["queries"], row["parameters"]) == ("cpu, 1 thread", queries, 1_234_567)
    assert row["p50, ms"] == median(each["latency_p50_ms"] for each in told) == 12
    assert row["p95, ms"] == median(each["latency_p95_ms"] for each in told) == 22
    expected = sum(each["passes"] * each["num_queries"] for each in told) / queries
    assert row["passes"] == pytest.approx(expected) and row["tokens"] == "-"
    seconds = sum(each["total_s"] for each in told)
    assert row["Hz"] == pytest.approx(sum(each["steps"] for each in measured) / seconds)
    assert row["memory, MiB"] == 5
    (row,) = columns(smoothness)
    assert row["J2"]["mean"] == pytest.approx(0.2)


def test_two_devices_are_two_lines(report: Callable[..., dict[str, Any]]) -> None:
    rows = [
        values(seed, inference=inference(seed, device=device, tokens=7.0))
        for seed, device in enumerate("aabb")
    ]
    (table,) = report(rows)["Efficiency"]["charts"][0]["tables"]
    assert [(row["device"], row["p50, ms"]) for row in columns(table)] == [("a", 10.5), ("b", 12.5)]
    assert [row["tokens"] for row in columns(table)] == [7, 7]


def test_smoothness_alone_is_shown_of_a_policy_without_a_network(
    report: Callable[..., dict[str, Any]],
) -> None:
    rows = [values(seed, action_j2=0.5, action_j3=0.25) for seed in range(3)]
    ((table,),) = (each["tables"] for each in report(rows)["Efficiency"]["charts"])
    (row,) = columns(table)
    assert (table["title"], row["J2"]["mean"], row["J3"]["mean"]) == ("Smoothness", 0.5, 0.25)


def test_lines_of_before_have_no_such_section_and_are_told_so(report: Callable[..., dict[str, Any]]) -> None:
    old = ("inference", "action_j2", "action_j3")
    rows = [{name: value for name, value in values(0).items() if name not in old}]
    sections = report(rows)
    assert "Efficiency" not in sections
    assert any(line.startswith("Efficiency: ") for line in sections["Not in these files"]["lines"])


# Language


def told_otherwise(num_deaf: int) -> Rows:
    """Make twelve episodes as told, and told otherwise; of these, `num_deaf` end as if told nothing."""
    rows = []
    for seed in range(12):
        own = values(seed, policy=FDVLA) | {"target": [2, 2], "nearest_intersection": [2, 2]}
        deaf = seed < num_deaf
        other = values(seed, None if deaf else "wrong_intersection", policy=TOLD)
        rows += [own, other | {"target": [2, 2], "nearest_intersection": [2, 2] if deaf else [0, 1]}]
    return rows


@pytest.mark.parametrize("num_deaf", [0, 5, 12])
def test_language_use_equals_a_recount(num_deaf: int, report: Callable[..., dict[str, Any]]) -> None:
    rows = told_otherwise(num_deaf)
    own, other = (
        [row for row in rows if bool(row["policy"]["interventions"]) == is_told] for is_told in (False, True)
    )
    sections = report(own, other)
    (table,) = sections["Language use"]["tables"]
    (row,) = columns(table)
    assert (row["its own"]["successes"], row["another"]["successes"], row["pairs"]) == (12, num_deaf, 12)
    assert row["right intersection, its own"]["successes"] == 12
    assert (row["right intersection, another"]["successes"], row["right intersection, another"]["n"]) == (
        num_deaf,
        12,
    )
    assert row["points"]["difference"] == pytest.approx((num_deaf - 12) / 12)
    assert not any(line.startswith("Language use") for line in sections["Not in these files"]["lines"])


@pytest.mark.parametrize("planted", [{"weights_sha256": "f" * 64}, {"interventions": []}])
def test_other_weights_or_no_intervention_say_nothing_of_language(
    planted: dict[str, Any], report: Callable[..., dict[str, Any]]
) -> None:
    rows = told_otherwise(0)
    for row in rows:
        if row["policy"]["interventions"]:
            row["policy"] |= planted
    sections = report(rows)
    assert "Language use" not in sections
    (line,) = [line for line in sections["Not in these files"]["lines"] if line.startswith("Language use")]
    assert "lerobot-bomb audit FOLDER" in line


# Failures to look at


def failing(policy: PolicyIdentity = ACT) -> Rows:
    """Make failures of two classes, one of them rare, under two conditions."""
    classes = [None, "dropped", "dropped", "dropped", "dropped", "dropped", "imprecise"]
    return [
        values(seed, failure, policy=policy, spec={"perturbations": condition})
        for condition in ("none", "light:3")
        for seed, failure in enumerate(classes)
    ]


def test_each_sampled_failure_has_the_command_that_replays_its_line(
    report: Callable[..., dict[str, Any]],
) -> None:
    files = failing(), failing(FDVLA)
    tables = report(*files)["Failures to look at"]["tables"]
    assert len(tables) == 2
    for table, rows in zip(tables, files, strict=True):
        shown = columns(table)
        numbers = [row["failure"] for row in shown]
        assert numbers == ["dropped"] * NUM_SAMPLES + ["imprecise"] * 2
        for row in shown:
            command, replay, path, line = shlex.split(row["replay"])
            assert (command, replay) == ("lerobot-bomb", "replay")
            named = json.loads(Path(path).read_text().splitlines()[int(line.removeprefix("--line=")) - 1])
            assert named in json.loads(json.dumps(rows))
            assert (named["failure"], named["spec"]["seed"]) == (row["failure"], row["seed"])
            assert named["spec"]["perturbations"] == row["condition"]
        assert len({row["replay"] for row in shown}) == len(shown)


def test_the_line_is_that_of_the_file_as_replay_counts(tmp_path: Path) -> None:
    path = tmp_path / "r.jsonl"
    path.write_text("damaged\n" + "".join(json.dumps(row) + "\n" for row in failing()[:2]))
    assert main(["report", str(path), f"--output={tmp_path / 'r.html'}"]) == 0
    assert f"lerobot-bomb replay {path} --line=3" in (tmp_path / "r.html").read_text()


def test_the_sample_is_the_same_each_time(report: Callable[..., dict[str, Any]]) -> None:
    assert report(failing()) == report(failing())


class Videos(HTMLParser):
    """Sources of the page's videos."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.sources: list[str] = []
        self.feed(page.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "video":
            self.sources.append(dict(attrs)["src"] or "")


def test_videos_that_cannot_be_had_are_told_and_are_no_error(
    report: Callable[..., dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (table,) = report(failing(), flags=("--videos=1",))["Failures to look at"]["tables"]
    rows = columns(table)
    assert [row["video"][:9] for row in rows] == ["no video:", "", "", "no video:", ""]
    assert "outputs/act" in rows[0]["video"]  # where no checkpoint lies
    assert "failures that could not be shown: 2, as lerobot-bomb replay " in capsys.readouterr().err
    assert Videos(tmp_path / "out" / "r.html").sources == []


def test_failures_are_shown_as_videos_beside_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from lerobot_bomb.compat.hooks import policies as built
    from lerobot_bomb.sweep.manifest import plan
    from lerobot_bomb.sweep.store import Store
    from lerobot_bomb.sweep.worker import Worker

    flags = ("--env.type=bomb", "--env.image_size=32", "--env.fps=2", "--policy.device=cpu")
    monkeypatch.setattr(built, "_BUILT", [])  # the policies of other tests do not act here
    store = Store(tmp_path / "sweep", plan(("bomb_random",), (), ("none",), 7, 2, 2, flags))
    Worker(store).run(list(store.manifest.jobs))
    store.merge()
    results, page = store.folder / "results.jsonl", tmp_path / "a b" / "r.html"
    assert main(["report", str(results), f"--output={page}", "--videos=1"]) == 0
    sources = Videos(page).sources
    sections = json.loads(page.with_suffix(".json").read_text())
    (table,) = next(each["tables"] for each in sections if each["title"] == "Failures to look at")
    shown = [row for row in columns(table) if row["video"]]
    assert [row["video"] for row in shown] == sources
    assert len(sources) == len({row["failure"] for row in columns(table)}) >= 1
    rows = [json.loads(line) for line in results.read_text().splitlines()]
    for row in shown:
        assert row["video"].startswith("r_videos/")
        (steps,) = [each["steps"] for each in rows if each["spec"]["seed"] == row["seed"]]
        with av.open(str(page.parent / row["video"])) as file:
            assert sum(1 for _ in file.decode(video=0)) == steps + 1
    assert {path.suffix for path in (page.parent / "r_videos").iterdir()} == {".mp4"}
    text = page.read_text()
    assert "not as recorded" not in text
    assert text.count('src="data:image/jpeg;base64,') == len(sources)  # a filmstrip beside each video
    filmed = tmp_path / "filmed.html"
    assert main(["report", str(results), f"--output={filmed}", "--films=1"]) == 0
    assert filmed.read_text().count('src="data:image/jpeg;base64,') == len(sources)
    assert Videos(filmed).sources == [] and not (tmp_path / "filmed_videos").exists()


def test_names_beside_a_filmstrip_are_text_and_short() -> None:
    record = read(values(3, "dropped", instruction="<script>x</script>"))
    name = "<b>&" + "n" * 5000
    films = samples.section(Report([], [Sample(name, record, Path("a b.jsonl"), 7, film=b"jpeg")])).figures
    assert "<script>" not in films and "<b>" not in films
    assert "&lt;script&gt;x&lt;/script&gt;. dropped, none, seed 3" in films
    assert f"<pre>lerobot-bomb replay {escape(repr('a b.jsonl'))} --line=7" in films
    assert f'src="data:image/jpeg;base64,{b64encode(b"jpeg").decode()}"' in films
    heading = films.split("<h3")[1].split("</h3>")[0].split(">")[1]
    assert len(heading) < 120
    assert films.count("<h3") == films.count("<figure>") == 1


def test_without_filmstrips_there_are_only_tables() -> None:
    record = read(values(3, "dropped"))
    section = samples.section(Report([], [Sample("act", record, Path("a.jsonl"), 7)]))
    assert section.figures == "" and len(section.tables) == 1


# Published figures


def test_published_figures_are_marked_and_name_their_source(report: Callable[..., dict[str, Any]]) -> None:
    section = report([values(0)])["Published, not measured here"]
    assert [table["title"] for table in section["tables"]] == ["Success: bomb", "Speed"]
    for table in section["tables"]:
        for row in columns(table):
            assert row["model"].endswith(f"({MARK})") and row["source"] and row["figure"]


def test_every_environment_has_figures_and_no_row_stands_twice() -> None:
    assert SUCCESS.keys() <= {name.removeprefix("bomb_") for name in ENVIRONMENTS}
    for figures in (*SUCCESS.values(), SPEED):
        keys = [(each.model, each.setting, each.source) for each in figures]
        assert len(set(keys)) == len(keys)


# The page


def test_every_file_of_a_section_is_on_the_page() -> None:
    from lerobot_bomb.report import sections

    folder = Path(sections.__path__[0])
    names = {path.stem for path in folder.glob("*.py")} - {"__init__"}
    assert {*SECTIONS} == names


def test_the_page_stays_small_without_scripts_and_network(
    report: Callable[..., dict[str, Any]], tmp_path: Path
) -> None:
    rows = [
        values(
            seed, None if seed % 2 else "dropped", inference=inference(seed % 7), spec={"perturbations": each}
        )
        for each in ("none", "light:3", "camera:3", "all:3")
        for seed in range(100)
    ]
    report(rows, told_otherwise(3))
    text = (tmp_path / "out" / "r.html").read_text()
    assert len(text) < 5e6 and "<script" not in text and "http" not in text and "src=" not in text
