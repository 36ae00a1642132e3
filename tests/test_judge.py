from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from lerobot_bomb.bomb.board import BOARD
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.expert import expert_action
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.bomb.privileged_state import PrivilegedState
from lerobot_env_bomb.bomb.env import BombEnv

SMALL = RenderOptions(image_size=32)
SEED = 15  # its opening has a stone 1 with free intersections around it
Policy = Callable[[PrivilegedState, int], np.ndarray]


@pytest.fixture(scope="module")
def env() -> Iterator[BombEnv]:
    env = BombEnv(EpisodeSpec(seed=SEED), SMALL)
    yield env
    env.close()


def rollout(env: BombEnv, policy: Policy) -> dict:
    """Last info of an episode."""
    env.reset(seed=SEED)
    info, step, ended = {}, 0, False
    while not ended:
        _, _, terminated, truncated, info = env.step(policy(env.privileged_state(), step))
        ended, step = terminated or truncated, step + 1
    return info


def opened(action: np.ndarray, is_open: bool) -> np.ndarray:
    return np.array([*action[:3], 1.0 if is_open else -1.0], dtype=np.float32)


def expert(state: PrivilegedState, step: int) -> np.ndarray:
    return expert_action(state)


def stands_still(state: PrivilegedState, step: int) -> np.ndarray:
    return np.array([0, 0, 0, 1])


def never_closes(state: PrivilegedState, step: int) -> np.ndarray:
    return opened(expert_action(state), True)


def lets_go_high(state: PrivilegedState, step: int) -> np.ndarray:
    return expert_action(state) if step < 8 else np.array([0, 0, 1, -1.0 if step < 12 else 1.0])


def holds_for_ever(state: PrivilegedState, step: int) -> np.ndarray:
    return expert_action(state) if step < 8 else np.array([0, 0, 0.1, -1.0])


def holds_without_lifting(state: PrivilegedState, step: int) -> np.ndarray:
    return expert_action(state) if step < 7 and state.finger_opening > 0.03 else np.array([0, 0, 0, -1.0])


def takes_a_stone_of_the_board(state: PrivilegedState, step: int) -> np.ndarray:
    return expert_action(replace(state, goals=(replace(state.goals[0], stone=1),)))


def aiming_at(state: PrivilegedState, xyz: np.ndarray) -> PrivilegedState:
    return replace(state, goals=(replace(state.goals[0], xyz=xyz),))


def aims_at(offset_xy_m: tuple[float, float]) -> Policy:
    offset = np.array([*offset_xy_m, 0.0])
    return lambda state, step: expert_action(aiming_at(state, state.goals[0].xyz + offset))


def aims_at_the_tray(state: PrivilegedState, step: int) -> np.ndarray:
    return expert_action(aiming_at(state, np.array([0.17, 0.09, 0.0095])))


def brushes_a_stone_aside(state: PrivilegedState, step: int) -> np.ndarray:
    """Pushes stone 1 some 15 mm towards row 0 with closed fingers, then lets the expert run."""
    pushed = state.stone_xyz[1]
    home = np.array([*BOARD.intersection_xy(*BOARD.nearest_intersection(pushed[:2])), 0.007])
    if np.linalg.norm(pushed[:2] - home[:2]) > 0.013:
        return expert_action(state)
    start = home + np.array([0.0, -0.030, 0.0])
    offset = start - state.gripper_xyz
    if pushed[1] - home[1] > 1e-4 or np.linalg.norm(offset) < 0.004:
        return np.array([0, 0.25, 0, -1.0])
    goal = start + np.array([0, 0, 0.06 if np.linalg.norm(offset[:2]) > 0.004 else 0.0])
    return np.array([*np.clip((goal - state.gripper_xyz) / 0.04, -1, 1), -1.0])


@pytest.mark.parametrize(
    ("policy", "failure", "stage"),
    [
        (stands_still, "never_reached", "start"),
        (never_closes, "missed_grasp", "reached"),
        (holds_without_lifting, "timeout_holding", "grasped"),
        (holds_for_ever, "timeout_holding", "lifted"),
        (lets_go_high, "dropped", "lifted"),
        (aims_at_the_tray, "dropped", "lifted"),
        (takes_a_stone_of_the_board, "wrong_stone", "start"),
        (aims_at((0.0, 0.015)), "imprecise", "lifted"),
        (aims_at((0.0, 0.030)), "wrong_intersection", "lifted"),
        (brushes_a_stone_aside, "disturbed_others", "placed"),
        (expert, "", "placed"),
    ],
    ids=lambda value: getattr(value, "__name__", str(value)),
)
def test_each_way_to_fail_has_its_class(env: BombEnv, policy: Policy, failure: str, stage: str) -> None:
    info = rollout(env, policy)
    assert (info["failure"], info["stage"]) == (failure, stage)
    assert info["is_success"] == (failure == "")
    result = env.episode_result()
    assert (result.failure or "") == failure and result.is_success == info["is_success"]


def test_the_original_rule_takes_15_mm_for_a_success_and_30_mm_for_a_failure(env: BombEnv) -> None:
    near = rollout(env, aims_at((0.0, 0.015)))
    far = rollout(env, aims_at((0.0, 0.030)))
    assert near["is_success_bomb_v0"] and not near["is_success"]
    assert near["placement_error_mm"] == pytest.approx(15, abs=2)
    assert not far["is_success_bomb_v0"]


def test_the_tolerance_decides(env: BombEnv) -> None:
    mild = BombEnv(EpisodeSpec(seed=0, success_tolerance_mm=20.0), SMALL)
    info = rollout(mild, aims_at((0.0, 0.015)))
    mild.close()
    assert info["is_success"]


def test_other_stones_may_lie_as_they_do_only_within_10_mm(env: BombEnv) -> None:
    info = rollout(env, brushes_a_stone_aside)
    assert info["collateral_mm"] > 10 and info["placement_error_mm"] < 2
    assert info["is_success_bomb_v0"]
