"""Records that cannot be: fields that contradict each other, text that nobody can write or show."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from bomb_pusht_cases import pusht_row
from result_rows import ACT, old_row, printed, read, row, values

from lerobot_bomb.commands.main import main
from lerobot_bomb.pusht.episode import SUCCESS_COVERAGE
from lerobot_bomb.results.origin import PolicyIdentity
from lerobot_bomb.results.reading import parse_record
from lerobot_bomb.viewing.replay import MAX_BATCH, Replay


def damage_of(line: dict[str, Any] | str) -> str:
    """Return what is wrong with a line; '' if nothing is."""
    text = line if isinstance(line, str) else json.dumps(line)
    try:
        parse_record(text.encode())
    except ValueError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(
    ("failure", "other", "damage"),
    [
        (None, {"placement_error_mm": 400.0}, "placement_error_mm=400.0 is impossible with failure=null"),
        (None, {"stage": "lifted"}, 'stage="lifted" is impossible with failure=null'),
        (None, {"collateral_mm": 10.5}, "collateral_mm=10.5 is impossible with failure=null"),
        (None, {"progress": 0.5}, "progress=0.5 is impossible with failure=null"),
        (
            None,
            {"placement_error_mm": 1.0, "nearest_intersection": [2, 1]},
            "placement_error_mm=1.0 is impossible",
        ),
        ("disturbed_others", {"collateral_mm": 9.5}, "collateral_mm=9.5 is impossible"),
        ("imprecise", {"stage": "placed"}, 'stage="placed" is impossible with failure="imprecise"'),
        (
            "imprecise",
            {"nearest_intersection": [2, 1], "placement_error_mm": 40.0},
            "nearest_intersection=[2, 1]",
        ),
        ("wrong_intersection", {"nearest_intersection": [2, 2]}, "nearest_intersection=[2, 2] is impossible"),
        ("never_reached", {"stage": "grasped"}, 'stage="grasped" is impossible with failure="never_reached"'),
        ("dropped", {"is_success_bomb_v0": True, "placement_error_mm": 27.0}, "placement_error_mm=27.0"),
        (None, {"task_id": 3}, "task_id=3 is impossible with target=[2, 2], color="),
        (None, {"task_id": 50}, "task_id=50 is impossible"),
        (None, {"task_ids": [3, 4]}, "task_id=12 is impossible with task_ids=[3, 4]"),
        (None, {"levels": {"camera": 3}}, 'levels={"camera": 3} with spec.perturbations=none'),
        (None, {"levels": {"fog": 0}}, ""),
        (None, {"levels": {"fog": 1}}, 'levels={"fog": 1} with spec.perturbations=none'),
        (None, {"spec": {"perturbations": "light:2-3"}, "levels": {"light": 4}}, 'levels={"light": 4} with'),
        (None, {"spec": {"perturbations": "light:2-3"}, "levels": {}}, "levels={} with"),
        (None, {"spec": {"perturbations": "light:0-3"}, "levels": {}}, ""),
        (None, {"spec": {"perturbations": "light:2-3"}, "levels": {"light": 2}}, ""),
    ],
)
def test_fields_that_contradict_each_other_are_damage(
    failure: str | None, other: dict[str, Any], damage: str
) -> None:
    assert not damage_of(values(0, failure))
    found = damage_of(values(0, failure, **other))
    assert damage in found and bool(damage) == bool(found)


def test_records_from_before_an_axis_lack_its_level_under_all_axes() -> None:
    spec, levels = {"perturbations": "all:3"}, {"camera": 3, "light": 3}
    assert not damage_of(json.loads(old_row(0, spec=spec)) | {"levels": levels})
    assert "levels=" in damage_of(json.loads(old_row(0, spec=spec)) | {"levels": levels | {"light": 4}})
    assert "levels=" in damage_of(values(0, spec=spec) | {"levels": levels})


def test_a_row_that_its_batch_does_not_have_is_damage() -> None:
    identity = asdict(ACT) | {"batch_size": 2, "batch_row": 1}
    assert not damage_of(values(0) | {"policy": identity})
    found = damage_of(values(0) | {"policy": identity | {"batch_row": 2}})
    assert found == "policy.batch_row=2 is impossible with policy.batch_size=2"


def test_half_a_surrogate_pair_damages_its_line_only(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    half = row(1).replace("Put it there.", "Put it \\ud800.")
    assert main(["results", str(written(path, row(0) + half + row(2))), "--verbose"]) == 0
    printed_now = capsys.readouterr()
    assert "damaged records, which are not counted: 1" in printed_now.out and "2 episodes" in printed_now.out
    assert f"{path}:2: not an episode result: text with half a surrogate pair, '\\ud800'" in printed_now.err
    assert not damage_of(row(1).replace("Put it there.", "Put it \\ud83d\\ude00."))
    with pytest.raises(ValueError, match="codec can't decode"):
        parse_record(b'{"a": "\xed\xa0\x80"}')


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_what_a_terminal_would_obey_is_shown(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hostile = PolicyIdentity(
        "act", "out\x1b]0;owned\x07\x1b[31m\u202e\nsuccess 100 %", None, "a" * 64, "b" * 64
    )
    said = printed(path, row(0, policy=hostile), capsys)
    assert "\x1b" not in said and "\x07" not in said and "\u202e" not in said
    assert "out\\x1b]0;owned\\x07\\x1b[31m\\u202e\\nsuccess 100 %" in said
    assert "\nsuccess 100" not in said


# Other environments


@pytest.mark.parametrize(
    ("outcome", "other", "damage"),
    [
        ((0.96, None), {}, ""),
        ((0.96, None), {"coverage": 0.5}, "coverage=0.5 is impossible with is_success=true"),
        ((0.5, "timeout"), {"coverage": 0.6}, "coverage=0.6 is impossible with max_coverage=0.5"),
        ((0.98, "timeout"), {"coverage": 0.97}, "coverage=0.97 is impossible with is_success=false"),
        ((0.9, "almost"), {"coverage": 0.7}, 'coverage=0.7 is impossible with failure="almost"'),
        ((0.5, "timeout"), {"steps": 301}, "steps=301 is impossible with spec.max_steps=300"),
        ((0.5, "timeout"), {"levels": {"table": 1}}, 'levels={"table": 1} with spec.perturbations=none'),
    ],
)
def test_pushts_fields_that_contradict_each_other_are_damage(
    outcome: tuple[float, str | None], other: dict[str, Any], damage: str
) -> None:
    found = damage_of(pusht_row(0, "none", *outcome) | other)
    assert damage in found and bool(damage) == bool(found)


def test_pushts_rate_of_success_is_gym_pushts() -> None:
    from gym_pusht.envs import PushTEnv

    assert PushTEnv().success_threshold == SUCCESS_COVERAGE


def test_queries_that_an_episode_cannot_have_had_are_damage() -> None:
    measured = {
        "num_queries": 20, "total_s": 1.0, "latency_p50_ms": 40.0, "latency_p95_ms": 60.0, "passes": None,
        "tokens": None, "num_parameters": 1, "peak_memory_bytes": None, "device": "cpu",
    }  # fmt: skip
    assert not damage_of(values(0, inference=measured))
    found = damage_of(values(0, inference=measured | {"num_queries": 21}))
    assert found == "inference.num_queries=21 is impossible with steps=20"
    found = damage_of(values(0, inference=measured | {"latency_p50_ms": 61.0}))
    assert found == "inference.latency_p50_ms=61.0 is impossible with inference.latency_p95_ms=60.0"


# Replay


@pytest.mark.parametrize(
    ("seed", "number", "size"), [(1000, 0, MAX_BATCH + 1), (1000, 3, 1_000_000), (2, 3, 4), (9, 1, None)]
)
def test_a_batch_that_cannot_be_run_again_is_told_before_anything_is_made(
    seed: int, number: int, size: int | None, path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    identity = asdict(PolicyIdentity("bomb_random")) | {"batch_row": number, "batch_size": size}
    line = values(seed) | {"policy": identity}
    with pytest.raises(ValueError, match=f"policy.batch_row={number} of policy.batch_size={size or 1}, and"):
        Replay(read(line)).viewed_run()
    assert main(["replay", str(written(path, json.dumps(line) + "\n"))]) == 1
    assert capsys.readouterr().err.count("\n") == 1
