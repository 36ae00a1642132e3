"""Records that are read: of every release, damaged ones, lines and files that hold none."""

import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Annotated, Any, ClassVar

import pytest
from bomb_pusht_cases import pusht_row
from result_rows import ACT, old_row, printed, read, row, values

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.commands.main import main
from lerobot_bomb.environments import ENVIRONMENTS
from lerobot_bomb.results import reading
from lerobot_bomb.results.bomb import OLD_VERSION, EpisodeResult
from lerobot_bomb.results.groups import read_results
from lerobot_bomb.results.measures import mean_measure
from lerobot_bomb.results.pusht import PushTResult
from lerobot_bomb.results.reading import parse_record
from lerobot_bomb.results.record import Record
from lerobot_bomb.results.summary import summarise


def test_a_record_is_read_as_it_was_written() -> None:
    written = EpisodeResult(**vars(read(values(3))))
    assert parse_record(written.to_json().encode()) == written
    assert [*json.loads(written.to_json())] == [each.name for each in fields(EpisodeResult)]


def test_all_fields_of_a_release_must_be_there() -> None:
    for name in values(0).keys() - (EpisodeResult.earlier.keys() - {*EpisodeResult.versions[OLD_VERSION]}):
        with pytest.raises(ValueError, match=f"it lacks {name}$" if name != "protocol_version" else "None"):
            read({key: value for key, value in values(0).items() if key != name})


RECORD_TYPES: list[type[Record]] = [each.record for each in ENVIRONMENTS.values()]


@pytest.mark.parametrize("record_type", RECORD_TYPES)
def test_what_records_of_earlier_releases_lack_are_fields(record_type: type[Record]) -> None:
    nested = {name.partition(".")[0] for name in record_type.earlier}
    assert nested <= {each.name for each in fields(record_type)}
    assert {name for names in record_type.versions.values() for name in names} <= record_type.earlier.keys()


@pytest.mark.parametrize(("name", "value"), [("progress", 1.5), ("progress", None), ("task_id", -1)])
def test_fields_that_earlier_releases_did_not_write_are_checked_where_they_are(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{name}={json.dumps(value)} is impossible"):
        read(values(0) | {name: value})
    assert getattr(read({key: kept for key, kept in values(0).items() if key != name}), name) is None


def test_a_protocol_version_is_of_one_environment() -> None:
    versions = [version for each in RECORD_TYPES for version in each.versions]
    assert len(set(versions)) == len(versions)
    assert [each.env_type for each in RECORD_TYPES] == [*ENVIRONMENTS]


def test_lines_of_1_0_are_read_and_said_to_be_incomplete(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = printed(path, "\n".join(old_row(seed) for seed in range(3)), capsys)
    assert ": 3 episodes" in output
    assert "protocol 1.0, suite=place" in output
    assert "records of protocol 1.0 lack policy, mujoco_version, opengl_vendor, " in output
    assert "policy not recorded" in output
    assert main(["results", str(path), "--strict"]) == 0


def test_a_task_version_that_a_suite_never_had_is_refused() -> None:
    with pytest.raises(
        ValueError, match=r"task_version of suite place='1\.1' is unknown; choose one of: 1\.0"
    ):
        read(values(0, task_version="1.1"))


DAMAGED: dict[str, Any] = {
    "is_success=-5 is impossible": {"is_success": -5},
    "placement_error_mm=NaN is impossible": {"placement_error_mm": float("nan")},
    "collateral_mm=-1.0 is impossible": {"collateral_mm": -1.0},
    'failure="bored" is impossible': {"failure": "bored"},
    'is_success=true is impossible with failure="dropped"': {"failure": "dropped", "is_success": True},
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
    "target=[2, 2] is impossible with spec.target=[1, 1]": {"spec": asdict(EpisodeSpec(0, target=(1, 1)))},
    "protocol_version '0.0'; this package reads 1.0, 1.1, pusht-1.0": {"protocol_version": "0.0"},
}


@pytest.mark.parametrize("message", DAMAGED)
def test_a_damaged_line_is_named_and_the_others_count(
    message: str, path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path.write_text(row(0) + json.dumps(values(1) | DAMAGED[message]) + "\n" + row(2))
    assert main(["results", str(path), "--verbose"]) == 0
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
    assert main(["results", str(path), "--verbose"]) == 0
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


def test_the_command_fails_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["results", str(tmp_path / "absent.jsonl")]) == 1
    error = capsys.readouterr().err
    assert "absent.jsonl: no such results file" in error
    assert error.count("\n") == 1


def test_a_folder_is_no_results_file(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="is a folder; name a results file in it"):
        read_results(tmp_path)


def test_a_file_of_something_else_is_told_from_an_unfinished_one(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path.write_text('{"type": "act"}\nnonsense\n' * 20)
    assert main(["results", str(path)]) == 1
    _, error = capsys.readouterr().err.splitlines()
    assert "is no results file; name one that --env.results_path" in error


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
