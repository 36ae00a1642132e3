"""Perturbation axes of `bomb_pusht`: what they do to an episode, and what they leave alone."""

import re
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from bomb_pusht_cases import pusht_env, run
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_bomb.conditions import MAX_LEVEL
from lerobot_bomb.pusht.episode import PushTSpec
from lerobot_bomb.pusht.perturbations import PUSHT_AXES, PushTCondition, pusht_magnitude

pytest.importorskip("gym_pusht", reason="gym-pusht is not installed: pip install '.[pusht]'")

from lerobot_env_bomb.pusht.axes.goal import GoalPose
from lerobot_env_bomb.pusht.axes.language import FORMS
from lerobot_env_bomb.pusht.episode import TEMPLATES, sample_pusht_episode

SEEDS = st.integers(0, 2**31)
AXIS = st.sampled_from(list(PUSHT_AXES))
LEVEL = st.integers(1, MAX_LEVEL)
# what is equal in a pair unless the axis names it
NAMED = {"pixels": "images", "agent_pos": "scene", "block_pose": "scene", "goal_pose": "goal"}


def text_of(seed: int, condition: str) -> str:
    env = pusht_env(condition)
    env.reset(seed=seed)
    return env.task_description


@settings(max_examples=60, deadline=None)
@given(SEEDS, AXIS, LEVEL)
def test_a_pair_differs_only_in_what_its_axis_names_and_in_that_it_does(
    seed: int, axis: str, level: int
) -> None:
    changes = PUSHT_AXES[axis].changes
    nominal, perturbed = (run(pusht_env(condition), seed, 0)[0] for condition in ("none", f"{axis}:{level}"))
    for name, change in NAMED.items():
        is_equal = np.array_equal(nominal[name], perturbed[name])
        assert is_equal == (change not in changes), name
    assert (text_of(seed, "none") == text_of(seed, f"{axis}:{level}")) == ("instruction" not in changes)


@pytest.mark.parametrize("axis", PUSHT_AXES)
def test_physics_and_reward_change_where_the_axis_says_so(axis: str) -> None:
    changes = PUSHT_AXES[axis].changes
    has_moved, has_other_reward = False, False
    for seed in range(4):
        nominal, perturbed = run(pusht_env(), seed, 12), run(pusht_env(f"{axis}:5"), seed, 12)
        for name in ("agent_pos", "block_pose"):
            has_moved |= any(
                not np.array_equal(a[name], b[name]) for a, b in zip(nominal, perturbed, strict=True)
            )
        has_other_reward |= any(a["reward"] != b["reward"] for a, b in zip(nominal, perturbed, strict=True))
    assert has_moved == bool({"dynamics", "scene"} & set(changes))
    assert has_other_reward == bool({"dynamics", "scene", "goal"} & set(changes))


@settings(max_examples=40, deadline=None)
@given(SEEDS, st.dictionaries(AXIS, LEVEL, min_size=1), AXIS, LEVEL)
def test_an_axis_draws_the_same_whatever_the_others_do(
    seed: int, others: dict[str, int], axis: str, level: int
) -> None:
    condition = "+".join(f"{name}:{at}" for name, at in ({**others, axis: level}).items())
    together, alone = (
        sample_pusht_episode(PushTSpec(seed, perturbations=text)).perturbation
        for text in (condition, f"{axis}:{level}")
    )
    assert together.transforms[axis] == alone.transforms[axis]
    assert together.levels == {**others, axis: level}


@pytest.mark.parametrize("axis", [name for name, axis in PUSHT_AXES.items() if "images" in axis.changes])
def test_each_level_changes_images_more_than_the_one_below(axis: str) -> None:
    changes = []
    for level in range(MAX_LEVEL + 1):
        env = pusht_env(f"{axis}:{level}")
        images = [env.reset(seed=seed)[0]["pixels"].astype(float) for seed in range(30)]
        changes.append(np.stack(images))
    sizes = [np.abs(images - changes[0]).mean() for images in changes]
    assert all(above > 1.05 * below for below, above in pairwise(sizes)), sizes


@settings(max_examples=40, deadline=None)
@given(SEEDS, LEVEL)
def test_the_words_of_goal_say_where_the_target_is(seed: int, level: int) -> None:
    env = pusht_env(f"goal:{level}")
    _, info = env.reset(seed=seed)
    match = re.search(
        r"lies (\d+) pixels (left|right) of and (\d+) pixels (above|below) its usual place and is turned "
        r"(\d+) degrees (anti)?clockwise\.",
        env.task_description,
    )
    assert match is not None
    right = int(match[1]) * (-1 if match[2] == "left" else 1)
    below = int(match[3]) * (-1 if match[4] == "above" else 1)
    turn = int(match[5]) * (-1 if match[6] else 1)
    np.testing.assert_allclose(info["goal_pose"], [256 + right, 256 + below, np.pi / 4 + np.radians(turn)])
    shift_px = pusht_magnitude("goal", "shift", level)
    assert np.hypot(right, below) == pytest.approx(shift_px, abs=1) and abs(turn) == 12 * level


def test_a_target_that_lies_right_and_below_is_drawn_there_and_turns_clockwise() -> None:
    env = pusht_env()
    env.reset(seed=0)
    board = env._board
    places = []
    for change in (None, GoalPose(60, 40, 0), GoalPose(0, 0, 90)):
        board.goal_pose = np.array([256, 256, np.pi / 4])
        if change is not None:
            change.edit(board)
        green = np.argwhere((env.render() == (144, 238, 144)).all(axis=2)) / 384 * 512
        places.append(green.mean(axis=0)[::-1])
    np.testing.assert_allclose(places[1] - places[0], [60, 40], atol=12)  # parts lie below the block
    # the stem points to the lower left, and clockwise from there is the upper left
    assert places[0][0] < 250 and places[0][1] > 262
    assert places[2][0] < 250 and places[2][1] < 250


@settings(max_examples=60, deadline=None)
@given(SEEDS, LEVEL)
def test_everything_stays_on_the_board(seed: int, level: int) -> None:
    env = pusht_env(f"start:{level}+goal:{level}")
    _, info = env.reset(seed=seed)
    nominal = pusht_env()
    _, before = nominal.reset(seed=seed)
    assert (abs(info["pos_agent"] - 256) <= np.maximum(abs(before["pos_agent"] - 256), 101)).all()
    board = env._board
    goal = board.get_goal_pose_body(board.goal_pose)
    corners = np.array(
        [goal.local_to_world(v) for shape in board._block_shapes for v in shape.get_vertices()]
    )
    assert (corners > 8).all() and (corners < 504).all()


@pytest.mark.parametrize("goal", ["", "+goal:2"])
def test_every_sentence_names_the_target_once_and_leaves_no_place_open(goal: str) -> None:
    for sentence in (*TEMPLATES, *(text for form in FORMS for text in form)):
        assert sentence.count("{where}") == 1 and sentence.endswith(".")
    texts = {text_of(seed, f"language:{level}{goal}") for seed in range(25) for level in range(6)}
    assert len(texts) > 15
    assert all("{" not in text and ("usual place" in text) == bool(goal) for text in texts)


def test_latency_executes_the_action_before() -> None:
    env = pusht_env("dynamics:3")
    _, info = env.reset(seed=0)
    start = info["pos_agent"]
    far = np.where(start < 256, start + 150, start - 150)
    *_, info = env.step(far)
    assert np.abs(info["pos_agent"] - start).max() < 15, "noise only"
    *_, info = env.step(start)
    assert np.abs(info["pos_agent"] - start).min() > 30


def test_a_block_glides_on_where_damping_says_so() -> None:
    moved = []
    for condition in ("none", "dynamics:5"):
        env = pusht_env(condition)
        env.reset(seed=0)
        board: Any = env._board
        board.agent.position = (30, 30)
        board.block.position = (256, 256)
        board.block.velocity, board.block.angular_velocity = (300, 0), 0.0
        for _ in range(2):
            env.step(np.array([30.0, 30.0]))
        moved.append(board.block.position[0] - 256)
    assert moved[0] < 5
    # 0.1 s of its speed in all, of which 86 % in the first 0.2 s
    assert moved[1] == pytest.approx(300 * 0.1 * 0.865, rel=0.06)


def test_a_range_draws_each_level() -> None:
    drawn = [sample_pusht_episode(PushTSpec(seed, perturbations="goal:0-5")) for seed in range(40)]
    levels = {episode.perturbation.levels.get("goal", 0) for episode in drawn}
    assert levels == set(range(6))
    assert str(PushTCondition("goal_marker:1+all:2")) == "all:2+goal_marker:1"
