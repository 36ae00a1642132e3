"""The suites `goal` and `long`: a command means one thing on its board, and the expert does it."""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_bomb.bomb.board import BOARD, TRAY_CENTER_XY, TRAY_HALF_SIZE_XY, Intersection
from lerobot_bomb.bomb.commands import INTERSECTIONS, draw_command, is_heldout
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.expert import expert_action
from lerobot_bomb.bomb.go import is_legal_position
from lerobot_bomb.bomb.move import TRAY, Aim, distance_m
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.bomb.privileged_state import Goal, PrivilegedState
from lerobot_bomb.bomb.suite import Episode, find_suite, specs_of_tasks
from lerobot_bomb.bomb.suites import goal as goal_suite
from lerobot_bomb.bomb.suites import long as long_suite
from lerobot_bomb.envs.rollout import Moment, expert_agent, make_env, run_episode
from lerobot_bomb.results.bomb import EpisodeResult
from lerobot_bomb.results.groups import read_results
from lerobot_env_bomb.bomb.perturb import PerturbedEpisode, sample_episode

TASKS = {"goal": goal_suite.TASKS, "long": long_suite.TASKS}
SMALL = RenderOptions(image_size=32)
SEEDS = st.integers(0, 2**31)
CONDITIONS = ("none", "language:2", "language:3", "language:4", "language:5", "stones:5", "all:5")
SWAP, PUSH_LEFT, CLEAR_ROW = 2, 3, 7  # tasks of `goal`
OPENING_OF_4, TURNS_OF_4, COPY_2 = 2, 4, 10  # tasks of `long`

type Board = dict[Intersection, str]


# An independent reader: what the board must look like in the end, from what is said and seen


def color_of(episode: Episode, stone: int) -> str:
    return "white" if episode.layout.stone_is_white[stone] else "black"


def board_at_start(episode: PerturbedEpisode) -> Board:
    layout = episode.layout
    on_board = [i for i in np.flatnonzero(layout.stone_in_play) if i not in episode.supply]
    return {BOARD.nearest_intersection(layout.stone_xy[i]): color_of(episode, int(i)) for i in on_board}


def around(intersection: Intersection) -> set[Intersection]:
    row, column = intersection
    return {(row + 1, column), (row - 1, column), (row, column + 1), (row, column - 1)} & set(INTERSECTIONS)


def groups(board: Board) -> list[set[Intersection]]:
    found: list[set[Intersection]] = []
    for intersection, color in board.items():
        touching = [
            g for g in found if board[next(iter(g))] == color and any(around(c) & {intersection} for c in g)
        ]
        found = [g for g in found if g not in touching] + [{intersection}.union(*touching)]
    return found


def liberties(board: Board, group: set[Intersection]) -> set[Intersection]:
    return set().union(*map(around, group)) - board.keys()


def intersections_in(text: str) -> list[Intersection]:
    return [(int(r), int(c)) for r, c in re.findall(r"row (\d), column (\d)", text)]


def is_done(said: list[str], board: Board, pattern: Board, end: Board) -> bool:
    """Return True if the end is what a reader of the sentences, who knows no suite, would make."""
    text = " ".join(said).lower()
    if "off the board" in text:
        if found := re.search(r"take the (black|white) stone", text):
            (gone,) = [intersection for intersection, color in board.items() if color == found[1]]
        else:
            (gone,) = intersections_in(text)
        return end == {intersection: color for intersection, color in board.items() if intersection != gone}
    if "swap" in text:
        a, b = intersections_in(text)
        assert re.findall(r"the (black|white) stone", text) == [board[a], board[b]]
        return end == board | {a: board[b], b: board[a]}
    if found := re.search(r"push the (black|white) stone one intersection (?:to|towards) the (\w+)", text):
        (place,) = intersections_in(text)
        (intersection,) = [intersection for intersection, color in board.items() if color == found[1]]
        step = {"left": (0, -1), "right": (0, 1), "far": (-1, 0), "near": (1, 0)}[found[2]]
        others = {other: color for other, color in board.items() if other != intersection}
        assert place == (intersection[0] + step[0], intersection[1] + step[1])
        return end == others | {place: found[1]}
    if found := re.search(r"clear row (\d)", text):
        return end == {
            intersection: color for intersection, color in board.items() if intersection[0] != int(found[1])
        }
    if found := re.search(r"bring all (black|white) stones to the left side", text):
        kept = {c: color for c, color in board.items() if color != found[1] or c[1] <= 1}
        moved = {c: color for c, color in end.items() if c not in kept}
        same = Counter(end.values()) == Counter(board.values()) and kept.items() <= end.items()
        return same and all(color == found[1] and column <= 1 for (_, column), color in moved.items())
    if "capture" in text:
        found = re.search(r"capture the (?:(\d) )?(black|white) stones?", text)
        assert found
        in_atari = [g for g in groups(board) if board[min(g)] == found[2] and len(liberties(board, g)) == 1]
        (group,) = in_atari
        (point,) = liberties(board, group)
        assert len(group) == int(found[1] or 1)
        by = "white" if found[2] == "black" else "black"
        assert f"play {by} there" in text
        return end == {c: color for c, color in board.items() if c not in group} | {point: by}
    if "take back" in text:
        return end == {
            intersection: color
            for intersection, color in board.items()
            if intersection not in intersections_in(text)
        }
    if "copy the pattern" in text:
        return end == board | pattern
    if found := re.search(r"fill the free intersections of row (\d).*(black|white) last", text):
        free = [
            intersection
            for intersection in INTERSECTIONS
            if intersection[0] == int(found[1]) and intersection not in board
        ]
        colors = [found[2], "white" if found[2] == "black" else "black"]
        return end == board | {intersection: colors[i % 2] for i, intersection in enumerate(reversed(free))}
    moves = re.findall(r"(black|white) at row (\d), column (\d)", text)
    assert moves, text
    return end == board | {(int(r), int(c)): color for color, r, c in moves}


def board_at_end(episode: PerturbedEpisode) -> Board:
    """Return the board after the moves of the expert."""
    board = board_at_start(episode)
    stands = {stone: place for stone, place in standing(episode).items() if place in board}
    for aim in episode.aims:
        board.pop(stands.pop(aim.stone, (-1, -1)), None)
        if distance_m(np.array(aim.xy), TRAY) > 0:
            stands[aim.stone] = BOARD.nearest_intersection(np.array(aim.xy))
            board[stands[aim.stone]] = color_of(episode, aim.stone)
    return board


def standing(episode: Episode) -> dict[int, Intersection]:
    on_board = [int(i) for i in np.flatnonzero(episode.layout.stone_in_play) if i not in episode.supply]
    return {i: BOARD.nearest_intersection(episode.layout.stone_xy[i]) for i in on_board}


@pytest.mark.parametrize("suite", TASKS)
@pytest.mark.parametrize("condition", CONDITIONS)
@settings(max_examples=60, deadline=None)
@given(seed=SEEDS)
def test_a_reader_of_the_sentences_would_do_what_the_expert_does(
    suite: str, condition: str, seed: int
) -> None:
    episode = sample_episode(EpisodeSpec(seed, suite, perturbations=condition))
    said = [turn.instruction for turn in episode.turns]
    assert len(said) in (1, len(episode.plans[0]))
    assert is_done(said, board_at_start(episode), dict(episode.pattern), board_at_end(episode))


@pytest.mark.parametrize("suite", TASKS)
@settings(max_examples=100, deadline=None)
@given(seed=SEEDS)
def test_the_expert_follows_the_first_plan(suite: str, seed: int) -> None:
    episode = sample_episode(EpisodeSpec(seed, suite))
    plan = episode.plans[0]
    assert len(plan) == len(episode.aims) <= find_suite(suite).num_goals
    for number, (move, aim) in enumerate(zip(plan, episode.aims, strict=True)):
        assert aim.stone in move.stones and aim.is_slid == move.is_slid
        assert min(distance_m(np.array(aim.xy), place) for place in move.places) == 0
        assert move.after <= set(range(number))


@pytest.mark.parametrize("suite", TASKS)
@pytest.mark.parametrize("condition", ["none", "stones:5", "start:5", "all:5"])
@settings(max_examples=60, deadline=None)
@given(seed=SEEDS)
def test_stones_lie_legally_apart_and_within_reach(suite: str, condition: str, seed: int) -> None:
    episode = sample_episode(EpisodeSpec(seed, suite, perturbations=condition))
    layout = episode.layout
    assert is_legal_position(board_at_start(episode))
    xy = layout.stone_xy[layout.stone_in_play]
    distances = np.linalg.norm(xy[:, None] - xy[None], axis=-1)[np.triu_indices(len(xy), k=1)]
    assert (distances > 2 * layout.stone_radius_m).all()
    in_tray = layout.stone_xy[list(episode.supply)]
    to_edge = np.array(TRAY_HALF_SIZE_XY) - abs(in_tray - np.array(TRAY_CENTER_XY))
    assert (to_edge >= BOARD.stone_radius_m - 1e-9).all()
    if episode.pattern and len(in_tray):
        assert in_tray[:, 1].min() - BOARD.stone_radius_m > -0.058 - 1e-9, "the small board stays free"


# What is drawn


@pytest.mark.parametrize("suite", TASKS)
def test_all_tasks_are_drawn_and_each_can_be_asked_for(suite: str) -> None:
    numbers = range(find_suite(suite).num_tasks)
    assert {sample_episode(EpisodeSpec(seed, suite)).task_id for seed in range(200)} == set(numbers)
    for number, spec in zip(numbers, specs_of_tasks(EpisodeSpec(3, suite), numbers), strict=True):
        assert sample_episode(spec).task_id == number


@pytest.mark.parametrize("suite", TASKS)
def test_the_split_holds_out_commands_whose_parts_are_all_seen(suite: str) -> None:
    for task_id in range(len(TASKS[suite])):
        about: dict[str, list[tuple[int, ...]]] = {"train": [], "heldout": []}
        for split, drawn_of in about.items():
            for seed in range(120):
                spec = EpisodeSpec(seed, suite, split=split, task_id=task_id)
                drawn_of.append(draw_command(TASKS[suite], spec)[1].about)
        assert not any(is_heldout(task_id, parts) for parts in about["train"])
        assert all(is_heldout(task_id, parts) for parts in about["heldout"])
        for number in range(len(about["train"][0])):
            seen, asked = ({parts[number] for parts in about[split]} for split in ("train", "heldout"))
            assert asked <= seen, f"task {task_id} asks for what no training shows"


@pytest.mark.parametrize("suite", TASKS)
@pytest.mark.parametrize("option", [{"target": (1, 1)}, {"color": "black"}])
def test_target_and_colour_are_refused(suite: str, option: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"is not an option of --env.task={suite}"):
        make_env(EpisodeSpec(0, suite, **option), SMALL)


# What the judge says


def moments_of(
    spec: EpisodeSpec, act: Callable[[PrivilegedState, int], np.ndarray] | None = None
) -> Iterator[Moment]:
    env = make_env(spec, SMALL)
    count = iter(range(10_000))
    agent = expert_agent() if act is None else expert_agent(lambda state: act(state, next(count)))
    yield from run_episode(env, spec, agent)
    env.close()


@pytest.mark.parametrize(
    ("suite", "task_id"), [(suite, number) for suite, tasks in TASKS.items() for number in range(len(tasks))]
)
def test_the_expert_does_every_task_without_an_idle_step(suite: str, task_id: int) -> None:
    *moments, last = moments_of(EpisodeSpec(task_id, suite, task_id=task_id))
    assert last.info["is_success"] and last.info["progress"] == 1
    assert last.info["collateral_mm"] < 1
    assert last.step <= find_suite(suite).max_steps / 2
    progress = [moment.info["progress"] for moment in moments]
    assert progress == sorted(progress) and progress[0] == 0
    for moment in moments:
        assert moment.action is not None
        np.testing.assert_allclose(expert_action(moment.state), moment.action, atol=1e-3)  # memoryless


def follow(episode: Episode, aims: Sequence[Aim]) -> Callable[[PrivilegedState, int], np.ndarray]:
    """Return an agent that follows these aims as the expert follows its own."""
    height_m = episode.layout.rest_height_m
    goals = tuple(Goal(np.array([*aim.xy, height_m]), aim.stone) for aim in aims)
    return lambda state, step: expert_action(replace(state, goals=goals))


def test_moves_that_have_no_order_may_be_made_in_any() -> None:
    specs = (EpisodeSpec(seed, "goal", task_id=CLEAR_ROW) for seed in range(99))
    spec = next(spec for spec in specs if len(sample_episode(spec).aims) == 2)
    episode = sample_episode(spec)
    *_, last = moments_of(spec, follow(episode, episode.aims[::-1]))
    assert last.info["is_success"]


def test_either_stone_of_a_swap_may_go_aside() -> None:
    spec = EpisodeSpec(0, "goal", task_id=SWAP)
    episode = sample_episode(spec)
    aside, second_there, first_there = episode.aims
    aims = (replace(aside, stone=second_there.stone), first_there, second_there)
    *_, last = moments_of(spec, follow(episode, aims))
    assert last.info["is_success"]


def test_moves_in_the_wrong_order_fail() -> None:
    spec = EpisodeSpec(0, "long", task_id=OPENING_OF_4)
    episode = sample_episode(spec)
    *_, last = moments_of(spec, follow(episode, episode.aims[::-1]))
    assert not last.info["is_success"]
    assert last.info["failure"] in ("wrong_stone", "wrong_intersection")


def test_a_stone_that_is_to_be_pushed_must_not_be_lifted() -> None:
    def act(state: PrivilegedState, step: int) -> np.ndarray:
        return expert_action(replace(state, goals=tuple(replace(g, is_slid=False) for g in state.goals)))

    *_, last = moments_of(EpisodeSpec(0, "goal", task_id=PUSH_LEFT), act)
    assert last.info["failure"] == "lifted"


def test_any_stone_of_the_colour_will_do() -> None:
    spec = EpisodeSpec(0, "long", task_id=TURNS_OF_4)
    episode = sample_episode(spec)
    same = [aim.stone for aim in episode.aims if color_of(episode, aim.stone) == color_of(episode, 0)]
    other = dict(zip(same, same[::-1], strict=True))

    aims = [replace(aim, stone=other.get(aim.stone, aim.stone)) for aim in episode.aims]
    *_, last = moments_of(spec, follow(episode, aims))
    assert last.info["is_success"] and len(same) == 2


def test_a_stone_that_was_put_down_must_not_be_taken_again() -> None:
    is_down = []

    def act(state: PrivilegedState, step: int) -> np.ndarray:
        first = state.goals[0]
        lies = np.linalg.norm(state.stone_xyz[first.stone] - first.xyz) < 0.003
        if lies and state.gripper_xyz[2] > 0.05:
            is_down.append(step)
        beside = replace(first, xyz=first.xyz + np.array([0.0, 0.016, 0.0]))
        goals = (beside,) * len(state.goals) if len(is_down) > 8 else (first,) * len(state.goals)
        return expert_action(replace(state, goals=goals))

    *_, last = moments_of(EpisodeSpec(0, "long", task_id=COPY_2), act)
    assert (last.info["progress"], last.info["failure"]) == (0.5, "wrong_stone")


# Turn by turn


def test_each_turn_is_said_when_the_move_before_it_has_been_made() -> None:
    spec = EpisodeSpec(2, "long", task_id=TURNS_OF_4)
    episode = sample_episode(spec)
    said = [turn.instruction for turn in episode.turns]
    assert len(set(said)) == 4
    for moment in moments_of(spec):
        made = round(moment.info["progress"] * 4)
        assert moment.instruction == said[min(made, 3)]


def test_lerobot_eval_gives_a_policy_each_turn_as_it_is_said(
    stock_cli: Callable[..., None], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from lerobot_bomb.bomb.scripted_policy import ScriptedPolicy

    given: list[list[str]] = []
    select_action = ScriptedPolicy.select_action

    def spy(self: ScriptedPolicy, batch: dict[str, Any], **kwargs: object) -> Any:
        given.append(list(batch["task"]))
        return select_action(self, batch, **kwargs)

    monkeypatch.setattr(ScriptedPolicy, "select_action", spy)
    flags = (
        "--policy.type=bomb_expert --policy.device=cpu --env.type=bomb --env.task=long --env.image_size=32"
    )
    flags += f" --env.task_ids=[{TURNS_OF_4}] --seed=2 --eval.n_episodes=1 --eval.batch_size=1"
    results = tmp_path / "results.jsonl"
    stock_cli(
        "lerobot-eval", *flags.split(), f"--env.results_path={results}", f"--output_dir={tmp_path / 'eval'}"
    )
    episode = sample_episode(EpisodeSpec(2, "long", task_id=TURNS_OF_4))
    assert list(dict.fromkeys(text for (text,) in given)) == [turn.instruction for turn in episode.turns]
    (row,) = read_results(results, EpisodeResult)
    assert (row.is_success, row.progress, row.target, row.task_id) == (
        True,
        1.0,
        None,
        TURNS_OF_4,
    )
