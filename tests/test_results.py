import json
import re
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import pytest
from bomb_pusht_cases import pusht_row

from lerobot_bomb.bomb.board import COLORS, task_id
from lerobot_bomb.bomb.episode import PROTOCOL_VERSION, EpisodeSpec
from lerobot_bomb.bomb.perturbations import Condition
from lerobot_bomb.commands.main import main
from lerobot_bomb.environments import ENVIRONMENTS
from lerobot_bomb.results import reading
from lerobot_bomb.results.bomb import OLD_VERSION, EpisodeResult, median_error_mm
from lerobot_bomb.results.groups import read_results
from lerobot_bomb.results.means import mean_measure
from lerobot_bomb.results.origin import PolicyIdentity
from lerobot_bomb.results.pusht import PushTResult
from lerobot_bomb.results.reading import parse_record
from lerobot_bomb.results.record import Record, field_names
from lerobot_bomb.results.summary import summarise

ACT = PolicyIdentity("act", "outputs/act", None, "a" * 64, "b" * 64)
FDVLA = PolicyIdentity("fdvla", "me/fdvla", "0123456789ab", "c" * 64, "d" * 64)


def values(seed: int, failure: str | None = None, error: float | None = None, **other: Any) -> dict[str, Any]:
    """The fields of a line; those of the spec are given as `spec`."""
    spec = {"seed": seed} | other.pop("spec", {})
    episode = EpisodeSpec(**spec)
    target = spec.get("target") or other.get("target", (2, 2))
    color = spec.get("color") or other.get("color", "black")
    condition = Condition(episode.perturbations)
    is_placed = failure in (None, "disturbed_others")
    is_elsewhere = failure == "wrong_intersection" and target is not None
    result = EpisodeResult(
        task_version="1.0",
        spec=episode,
        instruction="Put it there.",
        task_id=task_id(target, color) if target and episode.suite == "place" else episode.task_id or 0,
        target=target,
        color=color,
        steps=20,
        progress=float(is_placed),
        is_success=failure is None,
        is_success_bomb_v0=failure is None and target is not None,
        failure=failure,
        stage="placed" if is_placed else "start" if failure == "never_reached" else "lifted",
        placement_error_mm=(40.0 if is_elsewhere else 1.0) if error is None else error,
        nearest_intersection=(target[0], (target[1] + 1) % 5)
        if target and is_elsewhere
        else target or (2, 2),
        collateral_mm=20.0 if failure == "disturbed_others" else 0.0,
        levels={axis: high for axis, _, high in condition.ranges},
        opengl_vendor="Mesa",
        opengl_renderer="llvmpipe",
        mujoco_version="3.8.1",
    )
    policy = other.pop("policy", ACT)
    return asdict(result) | {"policy": policy and asdict(policy)} | other


def row(seed: int, failure: str | None = None, error: float | None = None, **other: Any) -> str:
    return json.dumps(values(seed, failure, error, **other)) + "\n"


def read(values: dict[str, Any]) -> EpisodeResult:
    """Return the record of these fields."""
    record = parse_record(json.dumps(values).encode())
    assert isinstance(record, EpisodeResult)
    return record


def old_row(seed: int, **other: Any) -> str:
    """Write a row as protocol 1.0 did."""
    new = values(seed, **other)
    return json.dumps(
        {name: new[name] for name in new if name not in EpisodeResult.versions[OLD_VERSION]}
        | {"protocol_version": "1.0"}
    )


def printed(path: Path, text: str, capsys: pytest.CaptureFixture[str]) -> str:
    """Return what `lerobot-bomb results` says of a file."""
    path.write_text(text)
    assert main(["results", str(path)]) == 0
    return capsys.readouterr().out


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "results.jsonl"


def test_summary_counts_successes_errors_and_failures(path: Path) -> None:
    lines = [row(0), row(1, error=3.0), row(2, "imprecise", 14.0), row(3, "never_reached", 200.0)]
    lines += [row(4, "dropped", 99.0), row(5, "wrong_intersection", 45.0), row(6, "disturbed_others", 2.0)]
    path.write_text("".join(lines))
    records = read_results(path, EpisodeResult)
    summary = summarise([*records])
    assert (summary.rate.n, summary.rate.successes) == (7, 2)
    assert median_error_mm(records) == 3.0  # of 1, 2, 3, 14 and 45: only stones that were put down
    assert summary.failures == {
        "imprecise": 1,
        "never_reached": 1,
        "dropped": 1,
        "wrong_intersection": 1,
        "disturbed_others": 1,
    }


def test_an_episode_that_was_run_again_counts_once(path: Path) -> None:
    path.write_text(row(0, "dropped") + row(1) + row(0))
    assert summarise(read_results(path)).rate.successes == 2


def test_a_record_is_read_as_it_was_written() -> None:
    written = EpisodeResult(**{name: getattr(read(values(3)), name) for name in field_names(EpisodeResult)})
    assert parse_record(written.to_json().encode()) == written
    assert [*json.loads(written.to_json())] == [*field_names(EpisodeResult)]


def test_all_fields_of_a_release_must_be_there() -> None:
    for name in values(0).keys() - (EpisodeResult.earlier.keys() - {*EpisodeResult.versions[OLD_VERSION]}):
        with pytest.raises(ValueError, match=f"it lacks {name}$" if name != "protocol_version" else "None"):
            read({key: value for key, value in values(0).items() if key != name})


RECORD_TYPES: list[type[Record]] = [each.record for each in ENVIRONMENTS.values()]


@pytest.mark.parametrize("record_type", RECORD_TYPES)
def test_what_records_of_earlier_releases_lack_are_fields(record_type: type[Record]) -> None:
    nested = {name.partition(".")[0] for name in record_type.earlier}
    assert nested <= {*field_names(record_type)}
    assert {name for names in record_type.versions.values() for name in names} <= record_type.earlier.keys()


@pytest.mark.parametrize(("name", "value"), [("progress", 1.5), ("progress", None), ("task_id", -1)])
def test_fields_that_earlier_releases_did_not_write_are_checked_where_they_are(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{name}={json.dumps(value)} is impossible"):
        read(values(0) | {name: value})
    assert getattr(read({key: kept for key, kept in values(0).items() if key != name}), name) is None


def test_moves_made_are_shown_of_episodes_with_several(path: Path) -> None:
    several = {"target": None, "color": None, "spec": {"suite": "long"}}
    path.write_text(row(0, progress=1.0, **several) + row(1, "dropped", progress=0.5, **several))
    (line,) = [line for line in summarise(read_results(path)).lines() if line.startswith("moves made")]
    assert "75.0 %" in line
    path.write_text(row(0))
    assert not any(line.startswith("moves made") for line in summarise(read_results(path)).lines())


def test_a_protocol_version_is_of_one_environment() -> None:
    versions = [version for each in RECORD_TYPES for version in each.versions]
    assert len(set(versions)) == len(versions)
    assert [each.env_type for each in RECORD_TYPES] == [*ENVIRONMENTS]


DAMAGED: dict[str, Any] = {
    "is_success=-5 is impossible": {"is_success": -5},
    "placement_error_mm=NaN is impossible": {"placement_error_mm": float("nan")},
    "collateral_mm=-1.0 is impossible": {"collateral_mm": -1.0},
    'failure="bored" is impossible': {"failure": "bored"},
    "is_success=True with failure='dropped'": {"failure": "dropped", "is_success": True},
    "steps=0 is impossible": {"steps": 0},
    "steps=true is impossible": {"steps": True},
    'stage="released" is impossible': {"stage": "released"},
    "target=[2, 5] is impossible": {"target": [2, 5]},
    'color="red" is impossible': {"color": "red"},
    "image_size=0 is impossible": {"image_size": 0},
    "task_ids=[50] is impossible": {"task_ids": [50]},
    "policy=[] is impossible": {"policy": []},
    'policy.weights_sha256="a" is impossible': {"policy": asdict(ACT) | {"weights_sha256": "a"}},
    "--seed=-1 must lie in 0..4294967295": {"spec": asdict(EpisodeSpec(0)) | {"seed": -1}},
    "seed=4294967296 must lie in 0..4294967295": {"spec": asdict(EpisodeSpec(0)) | {"seed": 2**32}},
    "fps=3 does not divide": {"spec": asdict(EpisodeSpec(0)) | {"fps": 3}},
    "perturbations": {"spec": asdict(EpisodeSpec(0)) | {"perturbations": "camera:9"}},
    "it lacks spec.robot": {"spec": {k: v for k, v in asdict(EpisodeSpec(0)).items() if k != "robot"}},
    "spec has wind, of which": {"spec": asdict(EpisodeSpec(0)) | {"wind": 3}},
    "target=[2, 2], but spec.target=[1, 1]": {"spec": asdict(EpisodeSpec(0, target=(1, 1)))},
    "protocol_version '0.0'; this package reads 1.0, 1.1, pusht-1.0": {"protocol_version": "0.0"},
}


@pytest.mark.parametrize("message", DAMAGED)
def test_a_damaged_line_is_named_and_the_others_count(
    message: str, path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path.write_text(row(0) + json.dumps(values(1) | DAMAGED[message]) + "\n" + row(2))
    assert main(["results", str(path)]) == 0
    out, error = capsys.readouterr()
    assert f"{path}:2: not an episode result: " in error
    assert message in error
    assert error.count("\n") == 1
    assert "damaged records, which are not counted: 1" in out
    assert "2 episodes" in out
    assert main(["results", str(path), "--strict"]) == 1
    assert message in capsys.readouterr().err
    with pytest.raises(ValueError, match=r"results\.jsonl:2: not an episode result"):
        read_results(path)


@pytest.mark.parametrize(
    "line", [b"not json", b"[1]", b"{}", b"\xff\xfe", b"[" * 9999, (row(1)[:300] + row(2)).strip().encode()]
)
def test_a_line_that_is_no_result_does_not_take_the_others_along(
    line: bytes, path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path.write_bytes(row(0).encode() + line + b"\n\n" + row(3).encode().strip())
    assert main(["results", str(path)]) == 0
    out, error = capsys.readouterr()
    assert f"{path}:2: not an episode result" in error
    assert error.count("\n") == 1
    assert "2 episodes" in out


@pytest.mark.parametrize("text", ["", "\n"])
def test_a_file_without_an_episode_is_an_error(
    text: str, path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path.write_text(text)
    assert main(["results", str(path)]) == 1
    assert "no finished episode" in capsys.readouterr().err


def test_the_command_prints_a_summary(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = printed(path, row(0) + row(1, "dropped"), capsys)
    assert "1/2 = 50.0 %" in output
    assert "dropped 1" in output


def test_the_command_fails_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["results", str(tmp_path / "absent.jsonl")]) == 1
    error = capsys.readouterr().err
    assert "absent.jsonl: no such results file" in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("of_old", [{"task_version": "1.0"}, {"protocol_version": "1.0"}])
def test_results_of_different_task_versions_are_not_pooled(
    of_old: dict[str, str], path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    of_object: dict[str, Any] = {"spec": {"suite": "object"}}
    new = [row(seed, task_version="1.1", **of_object) for seed in (0, 1)]
    make_row: Callable[..., str] = old_row if "protocol_version" in of_old else row
    old = make_row(2, **of_object | of_old)
    output = printed(path, "".join(new) + old, capsys)
    assert f"{path}: 2 episodes" in output and f"{path}: 1 episode" in output
    assert re.search(r"2 groups of episodes, .* they differ in .*task_version", output)


def test_a_task_version_that_a_suite_never_had_is_refused() -> None:
    with pytest.raises(
        ValueError, match=r"task_version of suite place='1\.1' is unknown; choose one of: 1\.0"
    ):
        read(values(0, task_version="1.1"))


OTHER: dict[str, dict[str, Any]] = {
    "policy": {"policy": FDVLA},
    "protocol": {"protocol_version": "1.0"},
    "MuJoCo": {"mujoco_version": "3.9.0"},
    "OpenGL": {"opengl_renderer": "NVIDIA H200/PCIe/SSE2"},
    "image_size": {"image_size": 64},
    "render_preset": {"render_preset": "shadows"},
    "tasks": {"task_ids": [12]},
    "fps": {"spec": {"fps": 20}},
    "split": {"spec": {"split": "train"}},
    "robot": {"spec": {"robot": "fetch"}},
    "control_mode": {"spec": {"control_mode": "absolute"}},
    "success_tolerance_mm": {"spec": {"success_tolerance_mm": 5.0}},
}


@pytest.mark.parametrize("name", OTHER)
def test_what_does_not_compare_is_neither_pooled_nor_paired_and_named(
    name: str, path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = OTHER[name].get("spec", {}) | {"perturbations": "camera:3"}
    perturbed = [row(seed, "dropped", **(OTHER[name] | {"spec": spec})) for seed in (0, 1, 2)]
    output = printed(path, row(0) + row(1) + "".join(perturbed), capsys)
    assert (
        f"2 groups of episodes, neither pooled nor paired with each other; they differ in {name}\n" in output
    )
    assert f"{path}: 2 episodes" in output
    assert f"{path}: 3 episodes" in output
    assert "perturbed episodes without an unperturbed one to compare with: 3" in output
    assert "pairs," not in output
    if "spec" not in OTHER[name]:  # then the episodes are the same
        assert f"those of this file differ in {name}" in output


def test_two_policies_are_two_groups_with_pairs_of_their_own(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    retrained = PolicyIdentity("act", "outputs/act", None, "e" * 64, "b" * 64)
    moved = PolicyIdentity("act", "elsewhere", None, "a" * 64, "b" * 64)
    text = "".join(
        row(seed, failure, spec={"perturbations": condition}, policy=policy)
        for seed in (0, 1)
        for policy, failure in ((ACT, None), (retrained, "dropped"))
        for condition in ("none", "all:5")
    )
    output = printed(path, text + row(2, policy=moved), capsys)
    headings = [f"policy act outputs/act (weights {sha * 12}, settings bbbbbbbbbbbb)" for sha in "ae"]
    first, second = (output.index(heading) for heading in headings)
    assert "3/3 = 100.0 %" in output[first:second]
    assert "0/2 = 0.0 %" in output[second:]
    assert output[first:second].count("all:5: 2 pairs") == output[second:].count("all:5: 2 pairs") == 1
    assert "count no more" not in output


def test_of_several_groups_a_line_for_each_group_and_condition_comes_first(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    conditions = [row(0), row(1, "dropped"), row(0, spec={"perturbations": "camera:3"})]
    output = printed(path, "".join([*conditions, row(0, policy=FDVLA)]), capsys)
    assert output.split("\n\n")[1].splitlines() == [
        "policy, suite           perturbations  success, 95 % Wilson interval by seed",
        "act outputs/act, place           none               1/2 = 50.0 % [9.5, 90.5]",
        "act outputs/act, place       camera:3            1/1 = 100.0 % [20.7, 100.0]",
        "fdvla me/fdvla, place            none            1/1 = 100.0 % [20.7, 100.0]",
    ]
    assert "policy, suite" not in printed(path, "".join(conditions), capsys)


def test_one_target_and_all_targets_are_not_six_episodes(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one = [row(seed, spec={"target": (2, 2), "color": "black"}, task_ids=[12]) for seed in range(3)]
    every = [row(seed, "dropped", policy=FDVLA) for seed in range(3)]
    output = printed(path, "".join(one + every), capsys)
    assert "6 episodes" not in output
    assert "they differ in policy, tasks" in output
    assert "policy act outputs/act (weights aaaaaaaaaaaa, settings bbbbbbbbbbbb); tasks 12\n" in output
    assert (
        "policy fdvla me/fdvla@0123456789ab (weights cccccccccccc, settings dddddddddddd); target drawn; "
        in output
    )


@pytest.mark.parametrize("line", [row, old_row])
def test_numbered_tasks_are_one_set(line: Any, path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    specs = [{"target": divmod(i % 25, 5), "color": COLORS[i // 25]} for i in range(50)]
    task_ids = {"task_ids": list(range(50))} if line is row else {}
    lines = [line(7, spec=spec, **task_ids).strip() for spec in specs]
    output = printed(path, "\n".join(lines), capsys)
    assert "tasks 0..49\n" in output
    assert ": 50 episodes" in output
    assert "groups" not in output


def test_a_heading_says_what_was_asked(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spec = {"target": (1, 3), "robot": "fetch", "perturbations": "camera:3"}
    text = "".join(row(0, spec=spec | {"seed": seed}, color="white") for seed in (4, 7, 4))
    output = printed(path, text, capsys)
    assert "target row 1, column 3; colour drawn" in output
    assert (
        f"protocol {PROTOCOL_VERSION}, suite=place, robot=fetch, split=all, control_mode=relative, " in output
    )
    assert "perturbations=camera:3, seeds 4, 7" in output
    assert "256 px, render_preset fast, OpenGL Mesa, llvmpipe, MuJoCo 3.8.1, lerobot_bomb " in output
    assert "1 records are replaced by later ones of the same episode" in output
    assert 'without an unperturbed one to compare with: 2; add "none" to --env.perturbations' in output


def test_lines_of_1_0_are_read_and_said_to_be_incomplete(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = printed(path, "\n".join(old_row(seed) for seed in range(3)), capsys)
    assert ": 3 episodes" in output
    assert "protocol 1.0, suite=place" in output
    assert "records of protocol 1.0 lack policy, mujoco_version, opengl_vendor, " in output
    assert "policy not recorded" in output
    assert main(["results", str(path), "--strict"]) == 0


def test_a_perturbed_arm_is_compared_with_the_same_episodes_unperturbed(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    outcomes = {"none": "++++++-", "camera:3": "-----++", "all:5": "++"}  # by seed
    lines = [
        row(seed, None if outcome == "+" else "dropped", spec={"perturbations": condition})
        for condition, marks in outcomes.items()
        for seed, outcome in enumerate(marks)
    ]
    lines.append(row(99, spec={"perturbations": "all:5"}))  # has no pair
    output = printed(path, "".join(lines), capsys)
    test = "(exact McNemar test, adjusted for 2 conditions (Holm))"
    assert f"camera:3: 7 pairs, 5 lost, 1 won, p = 0.44 {test}" in output  # 2 x 0.21875
    assert f"all:5: 2 pairs, 0 lost, 0 won, p = 1 {test}" in output
    assert "without an unperturbed one to compare with: 1; add" in output
    assert f"{path} (perturbations=none): 7 episodes" in output


def test_numbered_tasks_of_one_seed_are_clusters(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    specs = [{"target": divmod(task, 5), "color": "black"} for task in range(6)]
    lines = [
        row(seed, None if seed % 2 else "dropped", spec=spec, task_ids=list(range(6)))
        for seed in range(4)
        for spec in specs
    ]
    # as four records, two of them successes, with Student's t for 3 degrees of freedom: 3.182
    expected = "success          12/24 = 50.0 % [7.7, 92.3] (95 % Wilson interval, 4 clusters by seed)"
    assert expected in printed(path, "".join(lines), capsys)
    expected = "success          3/6 = 50.0 % (no interval: all are of one seed)"
    failures = [None, "dropped"] * 3
    one = [
        row(0, failure, spec=spec, task_ids=list(range(6)))
        for failure, spec in zip(failures, specs, strict=True)
    ]
    assert expected in printed(path, "".join(one), capsys)


def test_a_folder_is_no_results_file(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="is a folder; name a results file in it"):
        read_results(tmp_path)


def test_a_file_of_something_else_is_told_from_an_unfinished_one(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path.write_text('{"type": "act"}\nnonsense\n')
    assert main(["results", str(path)]) == 1
    assert "is no results file; name one that --env.results_path" in capsys.readouterr().err


@dataclass(frozen=True, kw_only=True)
class WithPath(PushTResult):
    """Record of `bomb_pusht` with one measure more."""

    earlier: ClassVar = {**PushTResult.earlier, "path_px": None}
    measures: ClassVar = (*PushTResult.measures, mean_measure("path_px", "path", "mean, in pixels"))

    path_px: Annotated[float | None, lambda value: value is not None and value >= 0] = None


def test_a_measure_is_a_field_of_a_record_and_nothing_else(
    path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(reading, "record_type_of", lambda version: WithPath)
    old, *new = (pusht_row(seed, "none", 0.5, "timeout") for seed in range(3))
    new = [line | {"path_px": length} for line, length in zip(new, (100.0, 200.0), strict=True)]
    text = "".join(json.dumps(line) + "\n" for line in (old, *new))
    assert "path             150.000 [100.000, 200.000] (mean, in pixels)" in printed(path, text, capsys)
    assert not any(
        line.startswith("path") for line in summarise([parse_record(json.dumps(old).encode())]).lines()
    )
    assert main(["report", str(path), f"--output={path.with_name('r.html')}"]) == 0
    assert "path 150.000 [100.000, 200.000]" in path.with_name("r.json").read_text()
    with pytest.raises(ValueError, match="path_px=-1 is impossible"):
        parse_record(json.dumps(old | {"path_px": -1}).encode())


def of_evaluation(seeds: range, num_episodes: int, seed: int = 0, **other: Any) -> str:
    """Write rows of these seeds, of an evaluation of so many episodes from `seed` on."""
    evaluation = {"num_episodes": num_episodes, "seed": seed}
    return "".join(row(each, evaluation=evaluation, **other) for each in seeds)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (of_evaluation(range(7), 20), "7 of 20"),
        (of_evaluation(range(20), 20), ""),
        ("".join(map(row, range(7))), ""),  # of an earlier release
        (row(0) + of_evaluation(range(1, 8), 20), "7 of 20"),
        # begun again: once with another stop, once to the end, once with more episodes
        (of_evaluation(range(7), 20) + of_evaluation(range(3), 20), "7 of 20"),
        (of_evaluation(range(7), 20) + of_evaluation(range(20), 20), ""),
        (of_evaluation(range(7), 20) + of_evaluation(range(50), 50), ""),
        # of other seeds, of another policy
        (of_evaluation(range(7), 20) + of_evaluation(range(100, 109), 10, seed=100), "7 of 20 and 9 of 10"),
        (of_evaluation(range(7), 20) + of_evaluation(range(13), 20, policy=FDVLA), "7 of 20 and 13 of 20"),
        # several conditions or suites of one evaluation
        (
            of_evaluation(range(7), 14) + of_evaluation(range(4), 14, spec={"perturbations": "all:3"}),
            "11 of 14",
        ),
        (of_evaluation(range(7), 14) + of_evaluation(range(4), 14, spec={"suite": "object"}), "11 of 14"),
    ],
)
def test_episodes_that_an_evaluation_lacks_are_told(
    text: str, expected: str, path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path.write_text(text)
    assert main(["results", str(path)]) == 0
    told = f"{path}: {expected} episodes played; lerobot-eval was stopped, or still runs\n"
    assert capsys.readouterr().err == (told if expected else "")
    page = path.with_suffix(".html")
    assert main(["report", str(path), f"--output={page}"]) == 0
    assert ("episodes played" in page.read_text()) is bool(expected)
