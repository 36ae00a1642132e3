"""The environment that a recording shows, and which others a policy of it cannot act in."""

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lerobot_bomb.bomb.environment import Environment
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.suite import task_version
from lerobot_bomb.bomb.suites import SUITES
from lerobot_bomb.conditions import ALL
from lerobot_bomb.data.facts import DatasetFacts

IMAGE = {"dtype": "video", "shape": [64, 64, 3], "names": ["height", "width", "channels"]}
INFO: dict[str, Any] = {
    "robot_type": "bomb_fetch_v1.0",
    "fps": 20,
    "features": {
        "observation.images.workspace": IMAGE,
        "observation.images.wrist": IMAGE,
        "observation.depth.wrist": {"dtype": "float32", "shape": [64, 64]},
        "action": {"dtype": "float32", "shape": [4], "names": ["x", "y", "z", "gripper"]},
    },
}
ABSOLUTE = Environment(
    robot="fetch",
    control_mode="absolute",
    fps=20,
    image_size=64,
    cameras=("workspace", "wrist"),
    task_version="1.0",
    task="place",
    depth=True,
    task_ids=(7, 12),
)


def write_dataset(root: Path, bomb: dict[str, Any] | None, specs: Sequence[str | None] | None) -> Path:
    """Write what LeRobot's tools leave of a recording's metadata: two episodes, our columns or not."""
    (root / "meta" / "episodes").mkdir(parents=True)
    (root / "meta" / "info.json").write_text(json.dumps(INFO))
    if bomb is not None:
        (root / "meta" / "bomb.json").write_text(json.dumps(bomb))
    columns = {"length": [9, 9], **({} if specs is None else {"bomb/spec": specs})}
    pq.write_table(pa.table(columns), root / "meta" / "episodes" / "file-000.parquet")
    return root


def spec(suite: str, seed: int, **given: Any) -> str:
    return json.dumps(EpisodeSpec(seed, suite, **given).to_dict())


NUMBERED = [spec("place", 4, target=(1, 2), color="black"), spec("place", 3, target=(2, 2), color="black")]


@pytest.mark.parametrize(
    ("bomb", "specs", "task", "task_ids", "seeds"),
    [
        pytest.param({"task": "goal", "task_ids": [7, 12]}, NUMBERED, "goal", (7, 12), None, id="recorded"),
        pytest.param({"task": "place"}, None, "place", (), None, id="an old one"),
        pytest.param(None, NUMBERED, "place", (7, 12), [3, 4], id="bomb.json is lost"),
        pytest.param(None, [spec("object", 5), spec("object", 5)], "object", (), [5], id="drawn tasks"),
        pytest.param(None, [NUMBERED[0], spec("place", 4)], "place", (), [4], id="numbered and drawn"),
        pytest.param(None, [spec("place", 0), spec("goal", 1)], "goal+place", None, [0, 1], id="merged"),
        pytest.param(None, None, None, None, None, id="columns are lost"),
        pytest.param(None, [spec("place", 0), None], None, None, None, id="merged with an edited one"),
    ],
)
def test_suite_and_tasks_are_those_of_the_recording_or_of_its_episodes_or_unknown(
    bomb: dict[str, Any] | None,
    specs: Sequence[str | None] | None,
    task: str | None,
    task_ids: tuple[int, ...] | None,
    seeds: list[int] | None,
    tmp_path: Path,
) -> None:
    facts = DatasetFacts.read(write_dataset(tmp_path, bomb and {"recording": bomb}, specs))
    assert facts.environment == replace(ABSOLUTE, task=task, task_ids=task_ids)
    if bomb is None:
        assert facts.seeds == seeds


@pytest.mark.parametrize(("is_told", "seeds"), [(True, [3, 4, 5, 90]), (False, None)])
def test_static_scenes_have_a_seed_a_frame(is_told: bool, seeds: list[int] | None, tmp_path: Path) -> None:
    root = write_dataset(tmp_path, None, None)
    features = {**INFO["features"], "next.done": {"dtype": "bool", "shape": [1]}}
    (root / "meta" / "info.json").write_text(json.dumps({**INFO, "features": features}))
    columns: dict[str, Any] = {"length": [3, 9], "bomb/spec": [spec("place", 3), spec("place", 90)]}
    if is_told:
        columns["stats/next.done/min"] = [[1.0], [0.0]]
    pq.write_table(pa.table(columns), root / "meta" / "episodes" / "file-000.parquet")
    assert DatasetFacts.read(root).seeds == seeds


@pytest.mark.parametrize(
    "change",
    [
        {"robot_type": "so101_follower"},
        {"robot_type": None},
        {"features": {}},
        {"features": {**INFO["features"], "action": {"shape": [4], "names": ["a", "b", "c", "d"]}}},
        {"features": {**INFO["features"], "observation.images.wrist": {"shape": [96, 96, 3]}}},
    ],
)
def test_of_other_datasets_nothing_is_known(change: dict[str, Any]) -> None:
    assert Environment.of_dataset(INFO | change, "place", ()) is None


@pytest.mark.parametrize(
    ("robot_version", "task", "version"),
    [
        *(("1.1", task, "1.0") for task in ("place", "spatial", "place+spatial")),
        *(("1.1", task, "1.1") for task in ("object", "place+goal", ALL, None)),
        *(("1.0", task, "1.0") for task in ("place", "object", ALL, None)),
    ],
)
def test_the_version_is_that_of_the_suites(robot_version: str, task: str | None, version: str) -> None:
    info = INFO | {"robot_type": f"bomb_scara_v{robot_version}"}
    environment = Environment.of_dataset(info, task, ())
    assert environment is not None and environment.task_version == version


def test_flags_of_an_evaluation() -> None:
    assert " ".join(ABSOLUTE.eval_flags()) == (
        "--env.type=bomb --env.task=place --env.robot=fetch --env.control_mode=absolute --env.fps=20 "
        "--env.image_size=64 --env.depth=true --env.task_ids=[7,12]"
    )


@pytest.mark.parametrize(
    ("task", "flag", "text"),
    [
        (None, "--env.task=SUITE", "an unknown suite, robot"),
        ("object+place", "--env.task=object", "suite object+place, robot"),
        ("goal+long+object+place+spatial", "--env.task=all", "suite goal+long+object+place+spatial, robot"),
    ],
)
def test_what_is_said_of_no_suite_and_of_several(task: str | None, flag: str, text: str) -> None:
    several = replace(ABSOLUTE, task=task, task_ids=None)
    assert several.eval_flags()[1] == flag
    assert not [each for each in several.eval_flags() if "task_ids" in each]
    assert text in str(several)


@pytest.mark.parametrize(
    ("trained", "here"),
    [
        (None, "goal"),
        ("object", None),
        ("object+place", "object"),
        ("object+place", "object+place"),
        ("goal+long+object+place+spatial", "all"),
        ("all", "goal"),
    ],
)
def test_suites_in_which_a_policy_can_act(trained: str | None, here: str | None) -> None:
    assert replace(ABSOLUTE, task=trained).differences(replace(ABSOLUTE, task=here)) == []


@pytest.mark.parametrize(
    ("trained", "here"), [("object", "all"), ("object+place", "goal"), ("goal", "place")]
)
def test_a_suite_that_it_was_not_trained_for_is_another_environment(trained: str, here: str) -> None:
    message = (
        rf"with task={re.escape(trained)}; this one has task={here}: evaluate with --env\.task=[og]\w+, or"
    )
    with pytest.raises(ValueError, match=message):
        replace(ABSOLUTE, task=trained).check_same(replace(ABSOLUTE, task=here), "this act", "override")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"robot": "scara"}, "with robot=fetch; this one has robot=scara: evaluate with --env.robot=fetch"),
        ({"control_mode": "relative"}, "evaluate with --env.control_mode=absolute, or override"),
        ({"fps": 10, "image_size": 256}, "evaluate with --env.fps=20 --env.image_size=64, or override"),
        (
            {"cameras": ("workspace",)},
            "with cameras=workspace+wrist; this one has cameras=workspace: override",
        ),
        (
            {"task_version": "2.0"},
            "with task_version=1.0; this one has task_version=2.0: override",
        ),
    ],
)
def test_another_environment_is_an_error_that_names_the_flags(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"^this act was trained .*{re.escape(message)}"):
        ABSOLUTE.check_same(replace(ABSOLUTE, **change), "this act", "override")


def test_what_was_trained_on_all_suites_acts_in_each_of_its_version() -> None:
    of_all = replace(ABSOLUTE, task="all", task_version=task_version("all"))
    for suite in SUITES:
        of_all.check_same(
            replace(ABSOLUTE, task=suite, task_version=task_version(suite)), "this act", "override"
        )
    earlier = replace(of_all, task_version="1.0")
    with pytest.raises(ValueError, match=r"with task_version=1\.0; this one has task_version=1\.1: override"):
        earlier.check_same(replace(ABSOLUTE, task="goal", task_version="1.1"), "this act", "override")
    with pytest.raises(ValueError, match=r"evaluate with --env\.task=place"):
        ABSOLUTE.check_same(of_all, "this act", "override")


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"depth": False},
        {"task_ids": (0,)},
        {"cameras": ("workspace", "wrist", "top")},
    ],
)
def test_what_makes_no_other_environment(change: dict[str, Any]) -> None:
    ABSOLUTE.check_same(replace(ABSOLUTE, **change), "this act", "override")
