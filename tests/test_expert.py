from dataclasses import replace

import numpy as np
import pytest

from lerobot_bomb.bomb.board import BOARD, NUM_STONES
from lerobot_bomb.bomb.episode import EpisodeSpec, Stage
from lerobot_bomb.bomb.expert import FLOOR_M, expert_action
from lerobot_bomb.bomb.observation import MAX_STEP_M, WORKSPACE_LOW_M, RenderOptions
from lerobot_bomb.bomb.privileged_state import Goal, PrivilegedState
from lerobot_bomb.envs.rollout import expert_agent, run_episode
from lerobot_env_bomb.bomb.env import BombEnv
from lerobot_env_bomb.bomb.scene import WORKSPACE_HIGH, WORKSPACE_LOW

SMALL = RenderOptions(image_size=32)
TARGET_XYZ = np.array([0.0, 0.0, 0.0095])
STONE_XYZ = np.array([0.17, 0.0, 0.0095])
HELD, OPEN = 0.0248, 0.044  # finger openings, metres


def state_of(gripper_xyz: list[float], opening: float, stone_xyz: np.ndarray = STONE_XYZ) -> PrivilegedState:
    return PrivilegedState(
        gripper_xyz=np.array(gripper_xyz),
        finger_opening=opening,
        goals=(Goal(TARGET_XYZ, stone=0),),
        stone_xyz=np.concatenate([[stone_xyz], np.ones((NUM_STONES - 1, 3))]),
        stone_is_white=np.zeros(NUM_STONES, dtype=bool),
        stone_in_play=np.arange(NUM_STONES) == 0,
    )


def expert_episode(
    env: BombEnv, seed: int, noise: float = 0.0
) -> tuple[list[PrivilegedState], list[np.ndarray], dict]:
    """States before each action and after the last, the expert's actions, the last info."""
    rng, spec = np.random.default_rng(seed), EpisodeSpec(seed)
    moments = list(
        run_episode(env, spec, expert_agent(), lambda a: a + noise * np.array([*rng.standard_normal(3), 0]))
    )
    actions = [moment.action for moment in moments if moment.action is not None]
    return [moment.state for moment in moments], actions, moments[-1].info


@pytest.fixture(scope="module")
def env():
    env = BombEnv(EpisodeSpec(seed=0), SMALL)
    yield env
    env.close()


@pytest.fixture(scope="module")
def episodes(env: BombEnv) -> list[tuple[list[PrivilegedState], list[np.ndarray], dict]]:
    return [expert_episode(env, seed) for seed in range(10)]


def test_above_the_stone_it_descends_with_open_fingers() -> None:
    dx, dy, dz, gripper = expert_action(state_of([0.17, 0.0, 0.09], OPEN))
    assert (dx, dy) == (0, 0) and dz < -0.5 and gripper > 0


def test_low_beside_the_stone_it_rises_before_it_goes_across() -> None:
    dx, dy, dz, _ = expert_action(state_of([0.10, 0.0, 0.008], OPEN))
    assert (dx, dy) == (0, 0) and dz > 0.5


def test_high_beside_the_stone_it_goes_across() -> None:
    dx, dy, _, gripper = expert_action(state_of([0.10, 0.0, 0.05], OPEN))
    assert dx > 0.5 and dy == 0 and gripper > 0


def test_around_the_stone_it_closes() -> None:
    assert expert_action(state_of([0.17, 0.0, 0.007], OPEN))[3] < -0.5


def test_the_measured_opening_tells_closing_from_lifting() -> None:
    closing = expert_action(state_of([0.17, 0.0, 0.007], 0.040))
    lifting = expert_action(state_of([0.17, 0.0, 0.007], HELD))
    assert closing[2] <= 0 and lifting[2] > 0.4
    assert closing[3] < 0 and lifting[3] < 0


def test_fingers_closed_on_nothing_open_above_the_stone() -> None:
    _, _, dz, gripper = expert_action(state_of([0.17, 0.0, 0.016], 0.0))
    assert dz > 0.3 and gripper > 0


@pytest.mark.parametrize(("narrower_m", "gripper"), [(0.0115, 1.0), (0.008, 0.0), (0.005, -1.0)])
def test_fingers_that_close_on_less_than_a_stone_open_around_it(narrower_m: float, gripper: float) -> None:
    """A grip 8 mm narrower than the stone is empty; from 5 mm on, the stone may be what is held."""
    state = state_of([0.17, 0.0, 0.007], OPEN)
    grip = replace(state, finger_opening=2 * state.stone_radius_m - narrower_m)
    *_, dz, command = expert_action(grip)
    assert command == pytest.approx(gripper, abs=1e-6)
    # the stone is lifted as fast as the arm goes, or not at all
    assert dz > 0.4 if gripper < 0 else dz < 0


def test_it_carries_the_stone_across_then_down() -> None:
    across = expert_action(state_of([0.10, 0.0, 0.035], HELD, np.array([0.10, 0.0, 0.0375])))
    down = expert_action(state_of([0.0, 0.0, 0.035], HELD, np.array([0.0, 0.0, 0.0375])))
    assert across[0] < -0.5 and across[3] < 0
    assert down[2] < -0.3 and down[3] < 0


def test_on_the_target_it_releases_without_moving_then_goes_straight_up() -> None:
    release = expert_action(state_of([0.001, 0.0, 0.007], HELD, TARGET_XYZ))
    retreat = expert_action(state_of([0.001, 0.0, 0.007], OPEN, TARGET_XYZ))
    np.testing.assert_allclose(release, [0, 0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(retreat[[0, 1, 3]], [0, 0, 1], atol=1e-6)
    assert retreat[2] > 0.5


def test_it_goes_back_for_a_stone_that_a_release_left_off_the_target() -> None:
    _, _, dz, gripper = expert_action(
        state_of([0.010, 0.0, 0.007], OPEN, TARGET_XYZ + np.array([0.010, 0, 0]))
    )
    assert gripper < 0 and dz <= 0


def test_absolute_actions_are_metres_of_the_same_motion() -> None:
    state = state_of([0.10, 0.02, 0.05], OPEN)
    relative, absolute = expert_action(state), expert_action(replace(state, control_mode="absolute"))
    np.testing.assert_allclose(absolute[:3], state.gripper_xyz + MAX_STEP_M * relative[:3], atol=1e-6)
    assert absolute[3] == relative[3]


def test_a_faster_control_rate_takes_smaller_steps() -> None:
    state = state_of([0.10, 0.02, 0.05], OPEN)
    slow, fast = (expert_action(replace(state, fps=fps)) for fps in (10, 20))
    assert 0.4 < np.linalg.norm(fast[:3]) / np.linalg.norm(slow[:3]) < 0.8


def test_its_lowest_goal_is_within_the_workspace() -> None:
    assert WORKSPACE_LOW_M[2] < FLOOR_M < BOARD.thickness_m + BOARD.stone_height_m / 2


def test_it_succeeds_precisely_and_disturbs_nothing(episodes: list) -> None:
    for states, actions, info in episodes:
        assert info["is_success"], info
        assert info["placement_error_mm"] < 2 and info["collateral_mm"] < 1
        assert all((abs(action) <= 1).all() for action in actions)
        assert len(actions) < 40 and len(states) == len(actions) + 1


def test_no_step_is_idle_until_the_stone_is_placed(episodes: list) -> None:
    for states, actions, _ in episodes:
        for before, action, after in zip(states[:-1], actions, states[1:], strict=True):
            translation_m = MAX_STEP_M * np.linalg.norm(action[:3])
            fingers_m = abs(after.finger_opening - before.finger_opening)
            assert translation_m >= 0.0005 or fingers_m >= 0.0002


def test_it_is_memoryless(episodes: list) -> None:
    states = [state for states, _, _ in episodes for state in states[:-1]]
    actions = [action for _, actions, _ in episodes for action in actions]
    for i in np.random.default_rng(0).permutation(len(states)):
        np.testing.assert_array_equal(expert_action(states[i]), actions[i])


def test_a_state_saved_and_restored_gives_the_same_action(episodes: list) -> None:
    for states, actions, _ in episodes:
        for state, action in zip(states[:-1], actions, strict=True):
            restored = PrivilegedState.from_vector(state.to_vector())
            np.testing.assert_allclose(expert_action(restored), action, atol=1e-3)


def test_it_does_not_read_the_stage_nor_other_stones(episodes: list) -> None:
    for states, actions, _ in episodes:
        others_xyz = states[0].stone_xyz + 0.01
        for state, action in zip(states[:-1], actions, strict=True):
            others_xyz[state.goals[0].stone] = state.stone_xyz[state.goals[0].stone]
            changed = replace(state, stage=Stage.PLACED, stone_xyz=others_xyz)
            np.testing.assert_array_equal(expert_action(changed), action)


def test_it_is_continuous(episodes: list) -> None:
    """A hundredth of a millimetre changes an action by little, wherever an episode leads."""
    rng = np.random.default_rng(0)
    for states, _, _ in episodes:
        for state in states:
            for _ in range(5):
                gripper_xyz = state.gripper_xyz + rng.normal(0, 0.004, 3)
                opening = state.finger_opening + rng.normal(0, 0.004)
                here = replace(state, gripper_xyz=gripper_xyz, finger_opening=opening)
                near = replace(here, gripper_xyz=gripper_xyz + 1e-5, finger_opening=opening + 1e-5)
                assert abs(expert_action(near) - expert_action(here)).max() < 0.05


@pytest.mark.parametrize(
    ("mode", "fps"), [("absolute", 10), ("relative", 20), ("absolute", 20), ("relative", 8)]
)
def test_it_succeeds_in_other_control_modes_and_rates(mode: str, fps: int) -> None:
    env = BombEnv(EpisodeSpec(seed=3, control_mode=mode, fps=fps), SMALL)
    observation, _ = env.reset()
    ended, info = False, {}
    while not ended:
        action = expert_action(PrivilegedState.from_vector(observation["environment_state"]))
        if mode == "absolute":
            assert (action[:3] >= WORKSPACE_LOW - 1e-6).all() and (action[:3] <= WORKSPACE_HIGH + 1e-6).all()
        observation, _, terminated, truncated, info = env.step(action)
        ended = terminated or truncated
    env.close()
    assert info["is_success"], info


def test_it_recovers_from_noise_on_its_actions(env: BombEnv) -> None:
    infos = [expert_episode(env, seed, noise=0.05)[2] for seed in range(20, 30)]
    assert all(info["is_success"] for info in infos), infos


def test_it_takes_over_from_a_clumsy_start(env: BombEnv) -> None:
    """Start with closed fingers, pressed onto the table beside the stone."""
    env.reset(seed=3)
    for action in (
        [0.3, 0.5, -0.5, -1.0],
        [0.3, 0.5, -1.0, -1.0],
        [0.0, 0.0, -1.0, -1.0],
        [-0.5, -0.5, 0.0, 1.0],
    ):
        observation, *_ = env.step(np.array(action, dtype=np.float32))
    ended, info = False, {}
    while not ended:
        action = expert_action(PrivilegedState.from_vector(observation["environment_state"]))
        observation, _, terminated, truncated, info = env.step(action)
        ended = terminated or truncated
    assert info["is_success"], info
