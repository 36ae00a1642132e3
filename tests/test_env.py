import copy
import hashlib
import json
import pickle
import platform
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

import lerobot_env_bomb.bomb
from lerobot_bomb.bomb.episode import PROTOCOL_VERSION, EpisodeSpec
from lerobot_bomb.bomb.expert import expert_action
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.bomb.privileged_state import PrivilegedState
from lerobot_env_bomb.bomb.env import BombEnv

SMALL = RenderOptions(image_size=32)
STILL = np.array([0, 0, 0, 1], dtype=np.float32)
SEED = 4
Policy = Callable[[PrivilegedState, int], np.ndarray]


@pytest.fixture(scope="module")
def env() -> Iterator[BombEnv]:
    env = BombEnv(EpisodeSpec(seed=0), SMALL)
    yield env
    env.close()


def expert(state: PrivilegedState, step: int) -> np.ndarray:
    return expert_action(state)


def stands_still(state: PrivilegedState, step: int) -> np.ndarray:
    return STILL


def rollout(env: BombEnv, policy: Policy, seed: int = SEED) -> tuple[dict, int]:
    """Last info and number of steps of an episode."""
    env.reset(seed=seed)
    info, steps, ended = {}, 0, False
    while not ended:
        _, _, terminated, truncated, info = env.step(policy(env.privileged_state(), steps))
        ended, steps = terminated or truncated, steps + 1
    return info, steps


def digest(observation: dict) -> str:
    arrays = [*observation["pixels"].values(), observation["agent_pos"], observation["environment_state"]]
    return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()


def test_reward_is_1_on_the_last_step_of_a_success_alone(env: BombEnv) -> None:
    env.reset(seed=SEED)
    rewards, terminated, truncated = [], False, False
    while not (terminated or truncated):
        _, reward, terminated, truncated, _ = env.step(expert_action(env.privileged_state()))
        rewards.append(reward)
    assert terminated
    assert rewards == [0.0] * (len(rewards) - 1) + [1.0]
    # 0.5 s at rest after the release
    assert len(rewards) > 10


def test_an_ended_env_keeps_returning_its_last_transition(env: BombEnv) -> None:
    rollout(env, expert)
    first = env.step(STILL)
    second = env.step(-STILL)
    assert first[1:4] == second[1:4] == (0.0, True, False)
    assert first[4] == second[4] and first[4]["is_success"]
    assert digest(first[0]) == digest(second[0])
    env.reset(seed=SEED)
    assert env.step(STILL)[2] is False


def test_changing_a_final_observation_changes_no_later_one(env: BombEnv) -> None:
    env.reset(seed=SEED)
    ended = False
    while not ended:
        observation, _, terminated, truncated, _ = env.step(expert_action(env.privileged_state()))
        ended = terminated or truncated
        expected = digest(observation)
    for _ in range(2):
        for array in (*observation["pixels"].values(), observation["agent_pos"]):
            array[:] = 0
        observation = env.step(STILL)[0]
        assert digest(observation) == expected


def test_an_env_is_pickled_and_copied_before_its_first_reset_alone(env: BombEnv) -> None:
    fresh = BombEnv(EpisodeSpec(seed=5, fps=20), SMALL)
    for copied in (copy.copy(fresh), copy.deepcopy(fresh), pickle.loads(pickle.dumps(fresh))):
        assert copied.metadata["render_fps"] == 20
    env.reset(seed=SEED)
    for make_copy in (copy.copy, copy.deepcopy, pickle.dumps):
        with pytest.raises(TypeError, match="a BombEnv that has been reset cannot be pickled or copied"):
            make_copy(env)


@pytest.mark.parametrize(("fps", "limit"), [(10, 100), (20, 200), (8, 80)])
def test_the_horizon_is_10_seconds(fps: int, limit: int) -> None:
    env = BombEnv(EpisodeSpec(seed=0, fps=fps), SMALL)
    info, steps = rollout(env, stands_still)
    env.close()
    assert steps == limit == env._max_episode_steps
    assert info["failure"] == "never_reached" and env.metadata["render_fps"] == fps


def test_a_relative_action_of_1_moves_40_mm(env: BombEnv) -> None:
    before = env.reset(seed=SEED)[0]["agent_pos"]
    after = env.step(np.array([-1, 0, 0.5, 1], dtype=np.float32))[0]["agent_pos"]
    np.testing.assert_allclose(after[:3] - before[:3], [-0.04, 0, 0.02], atol=1e-3)
    assert after[3] == pytest.approx(0.044, abs=1e-4)


def test_an_absolute_action_is_where_the_gripper_goes() -> None:
    env = BombEnv(EpisodeSpec(seed=0, control_mode="absolute"), SMALL)
    env.reset()
    observation = {}
    for _ in range(3):
        observation, *_ = env.step(np.array([0.15, -0.02, 0.07, -1], dtype=np.float32))
    env.close()
    np.testing.assert_allclose(observation["agent_pos"][:3], [0.15, -0.02, 0.07], atol=1e-3)
    assert observation["agent_pos"][3] < 0.001


def test_actions_beyond_the_space_are_clipped(env: BombEnv) -> None:
    env.reset(seed=SEED)
    clipped = digest(env.step(np.array([-1, 0, 1, 1], dtype=np.float32))[0])
    env.reset(seed=SEED)
    assert digest(env.step(np.array([-7, 0, 3, 5], dtype=np.float32))[0]) == clipped


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros(3), r"action has shape \(3,\), expected \(4,\)"),
        (np.zeros((1, 4)), r"action has shape \(1, 4\), expected \(4,\)"),
        (np.array([0, np.nan, 0, 0]), "is not finite"),
        (np.array([0, np.inf, 0, 0]), "is not finite"),
        (np.full(4, 1e308), r"action \[1e\+308, .*\] is not finite in float32"),
        (np.full(4, 1j), "holds complex128, not numbers"),
        (np.array(["a"] * 4), r"action \['a', .*\] holds <U1, not numbers"),
        (np.array([None] * 4), "holds object, not numbers"),
    ],
)
def test_a_malformed_action_is_refused(env: BombEnv, action: np.ndarray, message: str) -> None:
    env.reset(seed=SEED)
    with pytest.raises(ValueError, match=message):
        env.step(action)


def test_a_split_without_the_target_is_refused_at_once() -> None:
    with pytest.raises(ValueError, match=r"--env\.target=\[2, 2\] is not in --env\.split=heldout"):
        BombEnv(EpisodeSpec(seed=0, split="heldout", target=(2, 2)))


def test_an_unknown_render_mode_is_refused() -> None:
    with pytest.raises(ValueError, match="render_mode='human' is unknown"):
        BombEnv(render_mode="human")


def test_step_and_render_need_a_reset() -> None:
    env = BombEnv()
    for call in (lambda: env.step(STILL), env.render, env.privileged_state, env.episode_result):
        with pytest.raises(ResetNeeded):
            call()
    env.close()


def test_resets_without_a_seed_play_fresh_episodes_that_a_seeded_one_reproduces() -> None:
    first, second = (BombEnv(EpisodeSpec(seed=5), SMALL) for _ in range(2))
    unseeded = [env.reset()[1]["seed"] for env in (first, second) for _ in range(2)]
    assert len(set(unseeded)) == 4
    seeds = [[env.reset(seed=seed)[1]["seed"] for seed in (7, None, None)] for env in (first, second)]
    first.close()
    second.close()
    assert seeds == [[7, 2029167941, 1342382292]] * 2  # of Gymnasium's generator


@pytest.mark.parametrize("vectorization_mode", ["sync", "async"])
def test_gymnasiums_vector_environment_without_a_seed_runs_episodes_of_its_own(
    vectorization_mode: str,
) -> None:
    own: dict = {"context": "forkserver"} if vectorization_mode == "async" else {}
    envs = gymnasium.make_vec("bomb/place-v0", 2, vectorization_mode, vector_kwargs=own, render_options=SMALL)
    seeds = envs.reset()[1]["seed"]
    envs.close()
    assert seeds[0] != seeds[1]


@pytest.mark.parametrize("seed", [np.int64(5), np.uint8(5), np.array(5)])
def test_a_seed_may_be_any_whole_number(env: BombEnv, seed: object) -> None:
    found = env.reset(seed=seed)[1]["seed"]  # pyright: ignore[reportArgumentType]
    assert found == 5 and type(found) is int


@pytest.mark.parametrize(
    ("seed", "error", "message"),
    [
        (-1, ValueError, r"--seed=-1 must lie in 0\.\.4294967295"),
        (2**32, ValueError, "--seed=4294967296 must lie in"),
        (1.5, TypeError, "seed 1.5 must be a whole number"),
        ("5", TypeError, "seed '5' must be a whole number"),
    ],
)
def test_a_seed_that_is_none_is_refused_and_leaves_the_episode_as_it_is(
    env: BombEnv, seed: object, error: type[Exception], message: str
) -> None:
    rollout(env, stands_still)
    with pytest.raises(error, match=message):
        env.reset(seed=seed)  # pyright: ignore[reportArgumentType]
    assert env.step(STILL)[3] is True and env.episode_result().steps == 100


def test_observations_lie_in_their_space(env: BombEnv) -> None:
    observation, _ = env.reset(seed=SEED)
    assert env.observation_space.contains(observation)
    assert observation["pixels"]["wrist"].shape == (32, 32, 3)
    state = PrivilegedState.from_vector(observation["environment_state"])
    np.testing.assert_allclose(observation["agent_pos"], [*state.gripper_xyz, state.finger_opening])
    rng = np.random.default_rng(0)
    for _ in range(20):
        observation, *_ = env.step(rng.uniform(-1, 1, 4).astype(np.float32))
        assert env.observation_space.contains(observation)


def test_the_workspace_camera_stands_and_the_wrist_camera_moves(env: BombEnv) -> None:
    before, _ = env.reset(seed=SEED)
    for _ in range(2):
        after, *_ = env.step(np.array([-1, 0, 0, 1], dtype=np.float32))
    changed = {
        camera: np.mean(np.abs(before["pixels"][camera].astype(int) - after["pixels"][camera]).max(-1) > 20)
        for camera in ("workspace", "wrist")
    }
    assert changed["workspace"] < 0.25 < 0.35 < changed["wrist"]


def test_info_is_flat(env: BombEnv) -> None:
    _, info = env.reset(seed=SEED)
    assert set(info) == {
        "is_success",
        "is_success_bomb_v0",
        "progress",
        "placement_error_mm",
        "nearest_row",
        "nearest_column",
        "stage",
        "failure",
        "collateral_mm",
        "seed",
    }
    assert info["seed"] == SEED and info["stage"] == "start" and info["failure"] == ""


@pytest.mark.usefixtures("usual_pictures")
def test_the_image_for_people_is_captioned_and_no_observation() -> None:
    env = BombEnv(EpisodeSpec(seed=0), SMALL)
    env.reset(seed=SEED)
    image = env.render()
    assert image is not None and image.dtype == np.uint8 and image.shape[1] == 768 and image.shape[0] > 384
    assert (image[390:] > 200).any()  # letters
    assert "stone" in env.task_description and env.task == "place"
    env.close()


def test_each_finished_episode_appends_one_line(tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    env = BombEnv(EpisodeSpec(seed=0), SMALL, results_path=str(path))
    rollout(env, expert, seed=SEED)
    env.step(STILL)
    rollout(env, stands_still, seed=SEED + 1)
    env.close()
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert [line["is_success"] for line in lines] == [True, False]
    assert [line["spec"]["seed"] for line in lines] == [SEED, SEED + 1]
    assert lines[1]["failure"] == "never_reached" and lines[1]["steps"] == 100
    assert lines[0]["protocol_version"] == PROTOCOL_VERSION == "1.1"
    assert lines[0]["policy"] is None
    assert lines[0]["mujoco_version"] == sys.modules["mujoco"].__version__
    assert lines[0]["machine"].startswith(platform.machine())
    assert lines[0]["opengl_vendor"] and lines[0]["opengl_renderer"]


def test_a_result_that_cannot_be_written_is_an_error_that_names_the_flag() -> None:
    env = BombEnv(EpisodeSpec(seed=0, fps=1), SMALL, results_path="/dev/full")
    message = r"--env\.results_path=/dev/full: the result of seed 4 could not .*No space left on device"
    with pytest.raises(OSError, match=message):
        rollout(env, stands_still, seed=SEED)
    env.close()


@pytest.mark.parametrize("render_mode", ["rgb_array", None])
@pytest.mark.parametrize("gym_id", sorted(lerobot_env_bomb.bomb.GYM_IDS))
def test_gymnasiums_checker_has_nothing_to_say(gym_id: str, render_mode: str | None) -> None:
    env = gymnasium.make(gym_id, render_options=SMALL, render_mode=render_mode).unwrapped
    assert env.render_mode == render_mode
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # advice on how to scale actions: absolute ones are metres by definition
        warnings.filterwarnings("ignore", message=".*recommend using a symmetric and normalized space.*")
        check_env(env)
    env.close()


def test_without_a_render_mode_render_draws_nothing_and_says_so() -> None:
    env = BombEnv(EpisodeSpec(seed=0), SMALL, render_mode=None)
    env.reset()
    with pytest.warns(UserWarning, match="make the environment with render_mode='rgb_array'"):
        assert env.render() is None
    env.close()


def test_import_is_light() -> None:
    heavy = ("torch", "lerobot", "transformers", "cv2")
    script = f"import sys, lerobot_env_bomb.bomb.env; print([m for m in {heavy} if m in sys.modules])"
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert run.stdout.strip() == "[]", run.stderr


def test_a_process_that_never_closes_its_env_exits_silently() -> None:
    # weakref registers one exit handler, when it is first used; here before mujoco registers its own
    code = """
import weakref
anything = set()
weakref.finalize(anything, int)
from lerobot_env_bomb.bomb.env import BombEnv
env = BombEnv()
env.reset()
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stderr == ""
