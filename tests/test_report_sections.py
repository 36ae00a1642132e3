"""Sections of a report beyond its rates: efficiency, language use, failures to look at, published figures."""

import json
import shlex
from base64 import b64encode
from collections.abc import Callable
from html import escape
from html.parser import HTMLParser
from pathlib import Path
from statistics import median
from typing import Any

import av
import pytest
from report_cases import Rows, columns
from result_rows import ACT, FDVLA, read, values

from lerobot_bomb.checkpoints.names import REPLACE_TASKS
from lerobot_bomb.commands.main import main
from lerobot_bomb.commands.report import NUM_SAMPLES
from lerobot_bomb.environments import ENVIRONMENTS
from lerobot_bomb.report.report import Report, Sample
from lerobot_bomb.report.sections import SECTIONS, samples
from lerobot_bomb.report.sections.published import MARK, SPEED, SUCCESS
from lerobot_bomb.results.origin import PolicyIdentity

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


@pytest.mark.parametrize(
    "planted", [{"weights_sha256": "f" * 64}, {"interventions": []}, {"config_sha256": "f" * 64}]
)
def test_other_weights_or_no_intervention_say_nothing_of_language(
    planted: dict[str, Any], report: Callable[..., dict[str, Any]]
) -> None:
    rows = told_otherwise(0)
    for row in rows:
        row["policy"] |= {"config_sha256": "0" * 64}
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
