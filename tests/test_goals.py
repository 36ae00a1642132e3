"""The expert's goals in episodes that another agent has begun: in another order, with an equal stone."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_memoryless import UndrawnEnv

from lerobot_bomb.bomb.board import COLORS
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.expert import current_goal, expert_action
from lerobot_bomb.bomb.goals import Course, course_goals
from lerobot_bomb.bomb.judge import LIFT_M, Judge
from lerobot_bomb.bomb.move import TRAY, Made, distance_m, open_moves, place_name, stones_left
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.bomb.privileged_state import Goal, PrivilegedState
from lerobot_bomb.bomb.suite import Episode
from lerobot_bomb.bomb.suites import SUITES
from lerobot_env_bomb.bomb.env import BombEnv
from lerobot_env_bomb.bomb.perturb import sample_episode

SMALL = RenderOptions(image_size=32)
SWAP, CLEAR_ROW, GATHER = 2, 7, 8  # tasks of `goal`
OPENING_OF_4, TURNS_OF_4, FILL_ROW, CAPTURE_2, COPY_3 = 2, 4, 6, 8, 11  # tasks of `long`


def xyz_at_start(episode: Episode) -> np.ndarray:
    return np.insert(episode.layout.stone_xy, 2, episode.layout.rest_height_m, axis=1)


def other_goal(episode: Episode) -> tuple[int, Goal] | None:
    """Return the first move that has another stone than the expert's, as (moves before it, its goal)."""
    for num_made, aim in enumerate(episode.aims):
        made: Made = {i: (each.stone, each.place) for i, each in enumerate(episode.aims[:num_made])}
        for plan in episode.plans[:1] if made else episode.plans[::-1]:
            others = [
                (number, stone)
                for number, move in open_moves(plan, made)
                for stone in sorted(stones_left(move, made) - {aim.stone})
            ]
            if others:
                course = Course(plan, made, made, carried=others[-1])
                return num_made, next(course_goals(course, episode.layout, xyz_at_start(episode)))[1]
    return None


@dataclass
class Seen:
    """State in which the expert goes on, with the instruction and the outcome so far."""

    state: PrivilegedState
    instruction: str
    info: dict[str, Any]


def begun_otherwise(env: BombEnv, spec: EpisodeSpec, is_made: bool) -> Iterator[Seen]:
    """Make the other move, or lift its stone only; from there on yield what the expert sees."""
    episode = sample_episode(spec)
    found = other_goal(episode)
    assert found is not None
    num_before, goal = found
    _, info = env.reset(seed=spec.seed)
    is_over, ended = False, False
    while not ended:
        state, num_made = env.privileged_state(), round(info["progress"] * len(episode.aims))
        is_lifted = state.stone_xyz[goal.stone, 2] > goal.xyz[2] + 2 * LIFT_M
        is_over |= num_made > num_before or (is_lifted and not is_made)
        if is_over:
            yield Seen(state, env.task_description, info)
        elif num_made == num_before:
            state = replace(state, goals=(goal,))
        _, _, terminated, truncated, info = env.step(expert_action(state))
        ended = terminated or truncated
    yield Seen(env.privileged_state(), env.task_description, info)


def two_stones_in_the_row() -> EpisodeSpec:
    specs = (EpisodeSpec(seed, "goal", task_id=CLEAR_ROW) for seed in range(99))
    return next(spec for spec in specs if len(sample_episode(spec).aims) == 2)


def test_a_turn_goes_on_after_an_equal_stone() -> None:
    spec = EpisodeSpec(3, "long", task_id=TURNS_OF_4)
    *seen, last = begun_otherwise(UndrawnEnv(spec, SMALL), spec, is_made=True)
    assert last.info["is_success"]
    for each in seen:
        goal = current_goal(each.state)
        color = COLORS[int(each.state.stone_is_white[goal.stone])]
        assert f"{color} at {place_name(goal.xyz[:2])}" in each.instruction


def test_label_and_masks_take_the_stone_left() -> None:
    spec = two_stones_in_the_row()
    env = BombEnv(spec, SMALL)
    state = next(begun_otherwise(env, spec, is_made=True)).state
    left, cleared = (aim.stone for aim in sample_episode(spec).aims)
    assert distance_m(state.stone_xyz[cleared, :2], TRAY) == 0
    assert current_goal(state).stone == left
    masks = env.object_masks()["workspace"]
    x, y = env.cameras()["workspace"].pixel_of(state.stone_xyz[left])
    assert masks["stone"][round(float(y)), round(float(x))]
    env.close()


def test_a_stone_beside_its_place_keeps_masks_right() -> None:
    env = UndrawnEnv(EpisodeSpec(3, "goal", task_id=SWAP), SMALL)
    env.reset(seed=3)
    episode, xyz = env._run.episode, env._now.stone_xyz.copy()
    aside, following, _ = episode.aims
    xyz[aside.stone, :2] = np.add(aside.xy, (0.016, 0.005))
    made: Made = {0: (aside.stone, aside.place)}
    judge = Judge(episode, episode.spec.fps, replace(env._now, stone_xyz=xyz), made)
    assert judge.goals()[0].stone == judge.next_goal().stone == following.stone
    env.close()


@pytest.mark.parametrize("is_made", [False, True], ids=["in_the_fingers", "made"])
@pytest.mark.parametrize(
    ("suite", "task_id"),
    [
        *(("goal", task_id) for task_id in (SWAP, CLEAR_ROW, GATHER)),
        *(("long", task_id) for task_id in (OPENING_OF_4, TURNS_OF_4, FILL_ROW, CAPTURE_2, COPY_3)),
    ],
)
def test_the_expert_finishes_what_another_begins(suite: str, task_id: int, is_made: bool) -> None:
    specs = (EpisodeSpec(seed, suite, task_id=task_id) for seed in range(99))
    spec = next(spec for spec in specs if other_goal(sample_episode(spec)))
    *_, last = begun_otherwise(UndrawnEnv(spec, SMALL), spec, is_made)
    assert last.info["is_success"], last.info


@pytest.mark.parametrize("suite", SUITES)
@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_at_the_start_the_goals_are_the_aims(suite: str, seed: int) -> None:
    episode = sample_episode(EpisodeSpec(seed, suite))
    goals = course_goals(Course(episode.plans[0], {}, {}), episode.layout, xyz_at_start(episode))
    assert [(goal.stone, *goal.xyz[:2], goal.is_slid) for _, goal in goals] == [
        (aim.stone, *aim.xy, aim.is_slid) for aim in episode.aims
    ]
