"""The environment that a recording shows, and which others a policy of it cannot act in."""

import re
from dataclasses import replace
from typing import Any

import pytest

from lerobot_bomb.bomb.suite import task_version
from lerobot_bomb.bomb.suites import SUITES
from lerobot_bomb.data.environment import Environment

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


def test_it_is_read_from_the_datasets_own_metadata() -> None:
    assert Environment.of_dataset(INFO, {"task": "place", "task_ids": [7, 12]}) == ABSOLUTE
    # a dataset that LeRobot has merged or edited holds no bomb.json
    assert Environment.of_dataset(INFO, {}) == replace(ABSOLUTE, task_ids=())


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
    assert Environment.of_dataset(INFO | change, {}) is None


def test_flags_of_an_evaluation() -> None:
    assert " ".join(ABSOLUTE.eval_flags()) == (
        "--env.type=bomb --env.task=place --env.robot=fetch --env.control_mode=absolute --env.fps=20 "
        "--env.image_size=64 --env.depth=true --env.task_ids=[7,12]"
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"robot": "scara"}, "with robot=fetch; this one has robot=scara: evaluate with --env.robot=fetch"),
        ({"control_mode": "relative"}, "evaluate with --env.control_mode=absolute, or insist"),
        ({"fps": 10, "image_size": 256}, "evaluate with --env.fps=20 --env.image_size=64, or insist"),
        (
            {"cameras": ("workspace",)},
            "with cameras=workspace+wrist; this one has cameras=workspace: insist",
        ),
        (
            {"task_version": "2.0"},
            "with task_version=1.0; this one has task_version=2.0: insist",
        ),
    ],
)
def test_another_environment_is_an_error_that_names_the_flags(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"^this act was trained .*{re.escape(message)}"):
        ABSOLUTE.check_same(replace(ABSOLUTE, **change), "this act", "insist")


def test_what_was_trained_on_all_suites_acts_in_each_of_its_version() -> None:
    of_all = replace(ABSOLUTE, task="all", task_version=task_version("all"))
    for suite in SUITES:
        of_all.check_same(
            replace(ABSOLUTE, task=suite, task_version=task_version(suite)), "this act", "insist"
        )
    earlier = replace(of_all, task_version="1.0")
    with pytest.raises(
        ValueError, match=r"task=all, task_version=1\.0; this one has task=goal, task_version=1\.1"
    ):
        earlier.check_same(replace(ABSOLUTE, task="goal", task_version="1.1"), "this act", "insist")
    with pytest.raises(ValueError, match=r"evaluate with --env\.task=place"):
        ABSOLUTE.check_same(of_all, "this act", "insist")


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
    ABSOLUTE.check_same(replace(ABSOLUTE, **change), "this act", "insist")
