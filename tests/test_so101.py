# pyright: reportAttributeAccessIssue=false
"""SO-101: its kinematics, and control by its joints as the real arm's driver has them."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from lerobot_bomb.bomb import so101
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import (
    ACTION_NAMES,
    AGENT_POS,
    WORKSPACE_HIGH_M,
    WORKSPACE_LOW_M,
    RenderOptions,
    action_bounds,
    state_names,
)
from lerobot_bomb.bomb.privileged_state import PrivilegedState
from lerobot_bomb.commands.main import main
from lerobot_bomb.data.recording import Recording
from lerobot_bomb.envs.rollout import expert_agent, run_episode
from lerobot_bomb.flag_errors import FlagError
from lerobot_env_bomb.bomb.configuration_bomb import BombEnvConfig
from lerobot_env_bomb.bomb.env import BombEnv
from lerobot_env_bomb.bomb.scene import Scene

SMALL = RenderOptions(image_size=32)
JOINTS = EpisodeSpec(seed=0, robot="so101", control_mode="joints")
OPEN_M = so101.MAX_HALF_OPENING_M


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene("so101")


@pytest.fixture(scope="module")
def env():
    env = BombEnv(JOINTS, SMALL)
    yield env
    env.close()


def random_joints(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(so101.LOW_RAD, so101.HIGH_RAD)


def test_the_kinematics_are_those_of_the_model(scene: Scene) -> None:
    rng, grip = np.random.default_rng(0), scene.data.site("grip")
    for _ in range(50):
        joints, opening_m = random_joints(rng), rng.uniform(0, OPEN_M)
        for name, angle in zip(so101.JOINTS, joints, strict=True):
            scene.data.joint(name).qpos = angle
        scene.data.joint("left_finger").qpos = opening_m
        mujoco.mj_kinematics(scene.model, scene.data)
        xyz, rotation = so101.grip_pose(joints, opening_m)
        np.testing.assert_allclose(xyz, grip.xpos, atol=1e-12)
        np.testing.assert_allclose(rotation, grip.xmat.reshape(3, 3), atol=1e-12)


def test_the_joints_reach_all_of_the_workspace_upright_and_within_their_limits() -> None:
    rng = np.random.default_rng(1)
    for xyz in rng.uniform(WORKSPACE_LOW_M, WORKSPACE_HIGH_M, (200, 3)):
        joints = so101.joints_at(xyz, OPEN_M)
        assert (joints > so101.LOW_RAD).all() and (joints < so101.HIGH_RAD).all()
        reached, rotation = so101.grip_pose(joints, OPEN_M)
        np.testing.assert_allclose(reached, xyz, atol=1e-12)
        np.testing.assert_allclose(rotation, np.eye(3), atol=1e-12)


def test_the_limits_are_the_models(scene: Scene) -> None:
    ranges = np.array([scene.model.joint(name).range for name in so101.JOINTS])
    np.testing.assert_allclose(ranges, np.stack([so101.LOW_RAD, so101.HIGH_RAD], axis=1), atol=5e-6)


def test_the_jaw_follows_the_opening() -> None:
    for half_m in np.linspace(0, OPEN_M, 9):
        assert so101.jaw_half_opening_m(float(so101.jaw_rad(half_m))) == pytest.approx(half_m, abs=1e-12)
    assert so101.jaw_half_opening_m(so101.HIGH_RAD[-1]) == OPEN_M  # opens no further here
    assert so101.jaw_half_opening_m(so101.LOW_RAD[-1]) < 0.003


def test_positions_are_in_the_drivers_units() -> None:
    joints = np.array([0.0, np.pi / 2, -np.pi / 4, 0.1, -0.2, so101.HIGH_RAD[-1]])
    said = so101.to_driver(joints)
    np.testing.assert_allclose(said, [0, 90, -45, *np.rad2deg([0.1, -0.2]), 100])
    np.testing.assert_allclose(so101.from_driver(said), joints)
    assert so101.to_driver(so101.LOW_RAD)[-1] == 0


def test_names_are_those_of_lerobots_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    from lerobot.robots.so_follower import SO101FollowerConfig, so_follower

    monkeypatch.setattr(so_follower, "FeetechMotorsBus", lambda motors, **_: SimpleNamespace(motors=motors))
    driver = so_follower.SOFollower(SO101FollowerConfig(port="none", id="none"))
    assert ACTION_NAMES["joints"] == tuple(driver.action_features)
    assert state_names("joints") == tuple(driver.observation_features)


def test_the_arm_goes_where_its_joints_are_sent(env: BombEnv) -> None:
    env.reset(seed=0)
    wanted = so101.to_driver(so101.joints_at(np.array([0.05, 0.02, 0.09]), OPEN_M))
    wanted[3] -= 5  # tilts the gripper, which no other control mode can
    for _ in range(8):
        observation, *_ = env.step(wanted)
    np.testing.assert_allclose(observation[AGENT_POS][:5], wanted[:5], atol=0.1)
    assert observation[AGENT_POS][5] == pytest.approx(wanted[5], abs=1)


def test_an_observation_lies_in_its_space_wherever_the_joints_are_sent() -> None:
    env, (low, high) = BombEnv(JOINTS, SMALL), action_bounds("joints")
    env.reset(seed=3)
    for corner in np.random.default_rng(3).random((20, 6)) < 0.5:
        observation, *_ = env.step(np.where(corner, low, high))
        assert env.observation_space.contains(observation)
    env.close()


def test_the_expert_places_stones_by_joints(env: BombEnv) -> None:
    for seed in range(5):
        *_, last = run_episode(env, replace(JOINTS, seed=seed), expert_agent())
        assert last.info["is_success"] and last.info["collateral_mm"] < 0.5


def test_late_commands_are_anticipated(env: BombEnv) -> None:
    late = replace(JOINTS, perturbations="dynamics:5")
    successes = []
    for seed in range(4):
        *_, last = run_episode(env, replace(late, seed=seed), expert_agent())
        successes.append(last.info["is_success"])
    assert sum(successes) >= 3


def test_the_true_state_tells_the_control_mode(env: BombEnv) -> None:
    observation, _ = env.reset(seed=0)
    state = PrivilegedState.from_vector(observation["environment_state"])
    assert state.control_mode == "joints" and state.max_opening_m == pytest.approx(2 * OPEN_M)


@pytest.mark.parametrize("robot", ["scara", "fetch"])
def test_other_arms_have_no_joint_commands(robot: str) -> None:
    with pytest.raises(FlagError, match=rf"--env\.control_mode=joints .*--env\.robot=so101, not of {robot}"):
        BombEnvConfig(robot=robot, control_mode="joints")


def test_labels_of_pointing_are_refused_with_joints() -> None:
    with pytest.raises(ValueError, match=r"--env\.control_mode=joints: --pointing and --static"):
        Recording(repo_id="me/x", seed=0, episodes=1, robot="so101", control_mode="joints", pointing=True)


def test_recordings_have_the_real_arms_features(tmp_path: Path, stock_cli: Callable[..., None]) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root, results = tmp_path / "data", tmp_path / "results.jsonl"
    flags = "--env.robot=so101 --env.control_mode=joints --env.image_size=32 --images --episodes=2 --seed=5"
    assert main(["record", "--repo_id=me/so101", f"--root={root}", *flags.split()]) in (0, None)
    dataset: Any = LeRobotDataset("me/so101", root=root)
    names = list(ACTION_NAMES["joints"])
    for key in ("action", "observation.state"):
        assert dataset.meta.features[key]["names"] == names
    assert dataset.meta.robot_type.startswith("bomb_so101_v")
    # an action is where the joints are sent: at the end of the control step they are near it
    frames = [dataset[i] for i in range(dataset.meta.episodes[0]["length"])]
    for frame, following in pairwise(frames):
        np.testing.assert_allclose(following["observation.state"][:5], frame["action"][:5], atol=4)
    expert = "--policy.type=bomb_expert --policy.device=cpu --eval.n_episodes=1 --eval.batch_size=1"
    env = f"--env.type=bomb --env.robot=so101 --env.control_mode=joints --env.results_path={results}"
    stock_cli("lerobot-eval", *env.split(), *expert.split(), f"--output_dir={tmp_path / 'eval'}")
    assert '"control_mode": "joints"' in results.read_text()
