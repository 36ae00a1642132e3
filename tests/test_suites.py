"""The suites beside `place`: an instruction means one stone and one place, and the expert brings it there."""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_bomb.bomb.board import BOARD, TRAY_CENTER_XY, TRAY_HALF_SIZE_XY, Intersection
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.go import is_legal_position
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.bomb.suite import find_suite, specs_of_tasks
from lerobot_bomb.bomb.suites import object as object_suite
from lerobot_bomb.bomb.suites import spatial as spatial_suite
from lerobot_bomb.envs.rollout import expert_agent, make_env, run_episode
from lerobot_env_bomb.bomb.perturb import PerturbedEpisode, sample_episode
from lerobot_env_bomb.bomb.scene import WORKSPACE_HIGH, WORKSPACE_LOW

NEW_SUITES = ("object", "spatial")
SEEDS = st.integers(0, 2**31)
CONDITIONS = ("none", "language:1", "language:2", "language:3", "stones:5", "start:5", "all:5")


def stones_on_board(episode: PerturbedEpisode) -> dict[Intersection, str]:
    layout = episode.layout
    on_board = [i for i in np.flatnonzero(layout.stone_in_play) if i not in episode.supply]
    return {
        BOARD.nearest_intersection(layout.stone_xy[i]): "white" if layout.stone_is_white[i] else "black"
        for i in on_board
    }


def meant_stones(instruction: str, episode: PerturbedEpisode) -> set[int]:
    """Return the stones that a reader of the sentence, who knows no suite, takes from the tray."""
    layout, supply = episode.layout, list(episode.supply)
    xy = {i: layout.stone_xy[i] for i in supply}
    color = {i: "white" if layout.stone_is_white[i] else "black" for i in supply}
    if found := re.search(
        r"the stone (nearest to|farthest from) the (gripper|black stone|white stone)", instruction
    ):
        if found[2] == "gripper":
            others, origin = supply, layout.gripper_xyz[:2]
        else:
            named = [i for i in supply if color[i] == found[2].split()[0]]
            assert len(named) == 1, "the stone that another one is named by is one of several"
            others, origin = [i for i in supply if i not in named], xy[named[0]]
        pick = min if found[1] == "nearest to" else max
        distance = {i: float(np.hypot(*(xy[i] - origin))) for i in others}
        best = pick(distance.values())
        return {i for i in others if abs(distance[i] - best) < 0.010}
    if found := re.search(r"the (left|right|front)most stone", instruction):
        axis = 1 if found[1] == "front" else 0
        edge = (max if found[1] == "right" else min)(xy[i][axis] for i in supply)
        return {i for i in supply if abs(xy[i][axis] - edge) < 0.010}
    moved = re.sub(r"(left of|right of|behind|in front of|between) the (two )?\w+ stones?", "", instruction)
    found = re.search(r"\b(?:the|a) (black|white) (?:stone|piece)", moved.lower())
    assert found, instruction
    return {i for i in supply if color[i] == found[1]}


def meant_places(instruction: str, episode: PerturbedEpisode) -> set[Intersection]:
    """Return the places where that reader puts a stone."""
    stones = stones_on_board(episode)
    free = {(row, column) for row in range(5) for column in range(5)} - set(stones)
    if found := re.search(
        r"(to the left of|to the right of|behind|in front of) the (black|white) stone", instruction
    ):
        steps = {
            "to the left of": (0, -1),
            "to the right of": (0, 1),
            "behind": (-1, 0),
            "in front of": (1, 0),
        }
        d_row, d_column = steps[found[1]]
        return free & {(r + d_row, c + d_column) for (r, c), color in stones.items() if color == found[2]}
    if found := re.search(r"between the two (black|white) stones", instruction):
        pair = [intersection for intersection, color in stones.items() if color == found[1]]
        assert len(pair) == 2
        return free & {((pair[0][0] + pair[1][0]) // 2, (pair[0][1] + pair[1][1]) // 2)}
    if found := re.search(r"the (far|near) (left|right) corner", instruction):
        return free & {({"far": 0, "near": 4}[found[1]], {"left": 0, "right": 4}[found[2]])}
    if re.search(r"in the centre|on the star point", instruction):
        return free & {(2, 2)}
    if "only free intersection of a row" in instruction:
        rows = [{intersection for intersection in free if intersection[0] == row} for row in range(5)]
        return {intersection for row in rows if len(row) == 1 for intersection in row}
    return free & {episode.target}  # coordinates, which tests of `place` read


@pytest.mark.parametrize("suite", NEW_SUITES)
@pytest.mark.parametrize("condition", CONDITIONS)
@settings(max_examples=60, deadline=None)
@given(seed=SEEDS)
def test_exactly_one_stone_and_one_place_satisfy_the_instruction(
    suite: str, condition: str, seed: int
) -> None:
    episode = sample_episode(EpisodeSpec(seed, suite, perturbations=condition))
    assert meant_stones(episode.instruction, episode) == {episode.aims[0].stone}
    assert meant_places(episode.instruction, episode) == {episode.target}


@pytest.mark.parametrize("suite", NEW_SUITES)
@pytest.mark.parametrize("condition", ["none", "stones:5", "start:5", "all:5"])
@settings(max_examples=60, deadline=None)
@given(seed=SEEDS)
def test_stones_lie_legally_apart_and_within_reach(suite: str, condition: str, seed: int) -> None:
    episode = sample_episode(EpisodeSpec(seed, suite, perturbations=condition))
    stones, layout = stones_on_board(episode), episode.layout
    assert is_legal_position(stones)
    assert episode.allows(stones)
    xy = layout.stone_xy[layout.stone_in_play]
    distances = np.linalg.norm(xy[:, None] - xy[None], axis=-1)[np.triu_indices(len(xy), k=1)]
    assert (distances > 2 * layout.stone_radius_m).all()
    to_edge = np.array(TRAY_HALF_SIZE_XY) - abs(
        layout.stone_xy[list(episode.supply)] - np.array(TRAY_CENTER_XY)
    )
    assert (to_edge >= layout.stone_radius_m).all()
    assert (layout.gripper_xyz >= WORKSPACE_LOW).all() and (layout.gripper_xyz <= WORKSPACE_HIGH).all()


@pytest.mark.parametrize("suite", NEW_SUITES)
def test_a_numbered_task_is_run_and_all_are_drawn(suite: str) -> None:
    numbers = range(find_suite(suite).num_tasks)
    phrases = {"object": object_suite.TASKS, "spatial": spatial_suite.TASKS}[suite]
    for task_id, spec in zip(numbers, specs_of_tasks(EpisodeSpec(3, suite), numbers), strict=True):
        words = phrases[task_id].stone if suite == "object" else phrases[task_id].place
        words = re.escape(words).replace(r"\{anchor\}", "(black|white)")
        assert re.search(words, sample_episode(spec).instruction)
    drawn = {sample_episode(EpisodeSpec(seed, suite)).task_id for seed in range(200)}
    assert drawn == set(numbers)


@pytest.mark.parametrize(
    ("suite", "cases_of", "num_parts"),
    [("object", object_suite.pairs_of_split, 2), ("spatial", spatial_suite.cases_of_split, 3)],
)
def test_the_split_holds_out_combinations_whose_parts_are_all_seen(
    suite: str, cases_of: Callable[[str], tuple[tuple, ...]], num_parts: int
) -> None:
    shown, heldout = set(cases_of("train")), set(cases_of("heldout"))
    assert shown and heldout and not shown & heldout
    assert shown | heldout == set(cases_of("all"))
    for part in range(num_parts):
        assert {case[part] for case in heldout} <= {case[part] for case in shown}
    for seed in range(60):
        for split, expected in (("train", shown), ("heldout", heldout)):
            episode = sample_episode(EpisodeSpec(seed, suite, split=split))
            assert (episode.task_id, episode.target, episode.color)[:num_parts] in expected


@settings(max_examples=60, deadline=None)
@given(SEEDS, st.integers(0, 4), st.integers(0, 4))
def test_the_place_that_is_named_changes_nothing_in_the_tray(seed: int, row: int, column: int) -> None:
    spec = EpisodeSpec(seed, "object", task_id=0)
    drawn, given_target = sample_episode(spec), sample_episode(replace(spec, target=(row, column)))
    number = len(drawn.supply)
    assert given_target.aims[0].stone == drawn.aims[0].stone and given_target.supply == drawn.supply
    assert (given_target.layout.stone_xy[:number] == drawn.layout.stone_xy[:number]).all()
    assert (given_target.layout.gripper_xyz == drawn.layout.gripper_xyz).all()


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (EpisodeSpec(0, "spatial", target=(1, 1)), "--env.target=.* is not an option of --env.task=spatial"),
        (EpisodeSpec(0, "object", color="black"), "--env.color=black is not an option of --env.task=object"),
        (
            EpisodeSpec(0, "object", split="heldout", task_id=0, target=(0, 1)),
            "is not in --env.split=heldout",
        ),
        (
            EpisodeSpec(0, "spatial", split="train", task_id=5, color="black"),
            "--env.split=train has no task 5",
        ),
        (EpisodeSpec(0, "place", task_id=3), "names its tasks by target and colour"),
    ],
)
def test_an_option_that_a_suite_does_not_have_is_refused(spec: EpisodeSpec, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_env(spec, RenderOptions(image_size=32))


@pytest.mark.parametrize("suite", NEW_SUITES)
def test_task_numbers_outside_the_suite_are_refused(suite: str) -> None:
    number = find_suite(suite).num_tasks
    with pytest.raises(ValueError, match=rf"has {number}; '{suite}' has tasks 0..{number - 1}"):
        specs_of_tasks(EpisodeSpec(0, suite), [number])


@pytest.mark.parametrize("condition", ["none", "all:5"])
@pytest.mark.parametrize("suite", NEW_SUITES)
def test_the_expert_brings_the_stone_that_is_meant(suite: str, condition: str) -> None:
    spec = EpisodeSpec(0, suite, perturbations=condition)
    numbers = range(find_suite(suite).num_tasks)
    successes = []
    for task_id in numbers:
        env = make_env(replace(spec, task_id=task_id), RenderOptions(image_size=32))
        for moment in run_episode(env, replace(spec, seed=task_id), expert_agent()):
            last = moment
        successes.append(last.info["is_success"])
        env.close()
    assert np.mean(successes) >= (1.0 if condition == "none" else 0.8)
