"""`bomb_pusht` is gym-pusht at level 0, the same everywhere, and tells what became of its episodes."""

import copy
import hashlib
import itertools
import json
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from bomb_pusht_cases import pushing_actions, pusht_env, run
from lerobot.envs import env_to_policy_features, make_env, make_env_config
from lerobot.envs.utils import preprocess_observation

from lerobot_bomb.commands.main import main
from lerobot_bomb.conditions import nuisances_of
from lerobot_bomb.flag_errors import FlagError
from lerobot_bomb.pusht.episode import PushTFailure, PushTSpec, pusht_failure_of
from lerobot_bomb.pusht.perturbations import PUSHT_AXES
from lerobot_env_bomb.pusht.configuration_bomb_pusht import BombPushTEnvConfig

gym_pusht = pytest.importorskip(
    "gym_pusht.envs.pusht", reason="gym-pusht is not installed: pip install '.[pusht]'"
)

from gymnasium.utils.env_checker import check_env  # noqa: E402

GOAL = np.array([256.0, 256.0, np.pi / 4])
LAST_BITS = 1e-12  # gym-pusht's coverage differs by as much from process to process
CONDITION = "table:2+start:3+photometric:2+language:4+dynamics:5+object:3+goal:2+goal_marker:1"


def vector_envs(n_envs: int, use_async: bool = False, **flags: Any) -> Any:
    """The vector env of a config's only condition."""
    (group,) = make_env(BombPushTEnvConfig(**flags), n_envs=n_envs, use_async_envs=use_async).values()
    return group[0]


def stock(n_envs: int, steps: int) -> Any:
    """LeRobot's own vector env of `pusht`."""
    return make_env(make_env_config("pusht", episode_length=steps), n_envs=n_envs)["pusht"][0]


def test_level_0_with_the_empty_text_is_the_stock_environment() -> None:
    """20 seeds, actions that push the block: pictures, positions, rewards, ends, as lerobot-eval has them."""
    seeds, steps = list(range(100, 120)), 40
    ours = vector_envs(20, instruction="none", max_steps=steps, perturbations=["start:0"])
    theirs = stock(20, steps)
    (seen, info), (known, known_info) = ours.reset(seed=seeds), theirs.reset(seed=seeds)
    paths = [
        pushing_actions(seed, pose[:2], steps) for seed, pose in zip(seeds, info["block_pose"], strict=True)
    ]
    contacts = np.zeros(20)
    for step, action in enumerate(np.stack(paths, axis=1)):
        assert set(preprocess_observation(seen)) == set(preprocess_observation(known))
        np.testing.assert_array_equal(seen["pixels"], known["pixels"])
        np.testing.assert_array_equal(seen["agent_pos"], known["agent_pos"])
        for name in ("block_pose", "pos_agent", "vel_agent", "n_contacts", "is_success"):
            np.testing.assert_array_equal(info[name], known_info[name])
        if step == steps - 1:
            np.testing.assert_array_equal(ours.call("render"), theirs.call("render"))
        (seen, reward, ended, cut, info), (known, known_reward, known_ended, known_cut, known_info) = (
            env.step(action) for env in (ours, theirs)
        )
        np.testing.assert_allclose(reward, known_reward, rtol=0, atol=LAST_BITS)
        np.testing.assert_array_equal(ended, known_ended)
        np.testing.assert_array_equal(cut, known_cut)
        contacts += info["n_contacts"]
    assert cut.all() and np.mean(contacts > 0) > 0.8, "the actions meet the block"
    assert ours.call("task_description") == ("",) * 20
    ours.close()
    theirs.close()


def test_rewards_are_the_stock_ones_to_the_last_bit_where_those_are_the_same_in_every_process() -> None:
    env, exact = pusht_env(), 0
    env.reset(seed=0)
    board = env._board
    rng = np.random.default_rng(0)
    for _ in range(100):
        board.block.position = (256 + rng.normal(0, 30), 256 + rng.normal(0, 30))
        coverage = board._get_coverage()
        stock_coverage = gym_pusht.PushTEnv._get_coverage(board)
        if list(board.block.shapes) == board._block_shapes:
            assert coverage == stock_coverage
        assert coverage == pytest.approx(stock_coverage, abs=LAST_BITS)
        exact += coverage == stock_coverage
    assert exact > 10


@pytest.mark.parametrize("size", [32, 96, 100, 256, 511, 512])
def test_the_fast_image_is_the_stock_one(size: int) -> None:
    env = pusht_env(CONDITION, image_size=size)
    for seed in range(3):
        env.reset(seed=seed)
        screen = env._board._draw()
        for render_action in (False, True):
            image = env._board._get_img(screen, size, size, render_action)
            expected = gym_pusht.PushTEnv._get_img(env._board, screen, size, size, render_action)
            assert image.dtype == expected.dtype
            np.testing.assert_array_equal(image, expected)


def test_the_same_bits_in_one_after_the_other_in_sync_and_async_and_in_another_process() -> None:
    seeds, flags = [3, 4], {"perturbations": [CONDITION]}
    digests = []
    for use_async in (False, True):
        envs = vector_envs(2, use_async, **flags)
        rows = [b""] * 2
        observation, info = envs.reset(seed=seeds)
        for _ in range(2):
            for action in np.full((8, 2, 2), 256, np.float32):
                rows = [
                    row + pixels.tobytes() + pose.tobytes()
                    for row, pixels, pose in zip(rows, observation["pixels"], info["block_pose"], strict=True)
                ]
                observation, reward, *_, info = envs.step(action)
                rows = [row + value.tobytes() for row, value in zip(rows, reward, strict=True)]
            digests.append((rows, envs.call("task_description")))
            rows = [b""] * 2
            observation, info = envs.reset(seed=seeds)
        envs.close()
    assert all(digest == digests[0] for digest in digests[1:])
    code = (
        "import hashlib, sys; sys.path.insert(0, 'tests'); from bomb_pusht_cases import run, pusht_env\n"
        f"moments = run(pusht_env({CONDITION!r}), 3, 12)\n"
        "print(hashlib.sha256(b''.join(v.tobytes() for m in moments for v in m.values())).hexdigest())"
    )
    here = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[1],
    ).stdout
    moments = run(pusht_env(CONDITION), 3, 12)
    expected = hashlib.sha256(b"".join(v.tobytes() for m in moments for v in m.values())).hexdigest()
    assert here.strip() == expected


def test_gymnasiums_own_checks() -> None:
    check_env(pusht_env(CONDITION), skip_render_check=True)


def test_policy_side_features_are_the_stock_ones_in_the_images_true_size() -> None:
    ours, stock = (env_to_policy_features(make_env_config(name)) for name in ("bomb_pusht", "pusht"))
    assert {key: feature.type for key, feature in ours.items()} == {
        key: feature.type for key, feature in stock.items()
    }
    assert ours["observation.image"].shape == (3, 96, 96)


def test_each_condition_is_a_group_beside_its_nominal_arm() -> None:
    config = BombPushTEnvConfig(perturbations=["none", "goal:2+table:1", "all:1-5"])
    envs: Any = make_env(config, n_envs=1)
    assert list(envs) == ["pusht.none", "pusht.table-1.goal-2", "pusht.all-1to5"]
    nominal, perturbed = (envs[key][0] for key in ("pusht.none", "pusht.table-1.goal-2"))
    (first, info), (second, other) = nominal.reset(seed=[7]), perturbed.reset(seed=[7])
    np.testing.assert_array_equal(info["block_pose"], other["block_pose"])
    assert not np.array_equal(first["pixels"], second["pixels"])
    (said,), (more,) = nominal.call("task_description"), perturbed.call("task_description")
    assert more.startswith(said.rstrip(".")) and "usual place" in more


def pose(x: float, y: float, turned_deg: float) -> np.ndarray:
    return np.array([x, y, np.pi / 4 + np.radians(turned_deg)])


@pytest.mark.parametrize(
    ("end", "coverage", "touched", "failure"),
    [
        (pose(100, 100, 0), 0.0, False, "never_touched"),
        (pose(256, 256, 6), 0.85, True, "almost"),
        (pose(256, 256, 30), 0.5, True, "turned_wrong"),
        (pose(256, 256, -370), 0.79, True, "timeout"),
        (pose(256, 256, 10), 0.79, True, "timeout"),
        (pose(60, 60, 0), 0.0, True, "pushed_away"),
        (pose(150, 150, 30), 0.1, True, "timeout"),
        (pose(95, 95, 0), 0.0, True, "timeout"),
    ],
)
def test_a_failure_has_the_class_of_how_it_ended(
    end: np.ndarray, coverage: float, touched: bool, failure: str
) -> None:
    assert pusht_failure_of(pose(100, 100, 0), end, GOAL, coverage, touched) == failure


def test_an_episode_counts_contacts_of_the_agent_only() -> None:
    env = pusht_env(max_steps=3)
    for seed in range(6):
        _, info = env.reset(seed=seed)
        away = info["pos_agent"]
        for _ in range(3):
            *_, truncated, info = env.step(away)
        assert truncated and info["failure"] == "never_touched"
    _, info = env.reset(seed=0)
    for _ in range(3):
        *_, info = env.step(info["block_pose"][:2])
    assert info["n_contacts"] and info["failure"] not in ("never_touched", "")


def test_success_ends_an_episode_and_nothing_moves_after_it() -> None:
    env = pusht_env()
    env.reset(seed=0)
    board = env._board
    board.block.angle = GOAL[2]
    board.block.position = tuple(GOAL[:2])
    board.space.reindex_shapes_for_body(board.block)
    stay = np.array(board.agent.position)
    first = env.step(stay)
    assert first[1:4] == (1.0, True, False) and first[4]["is_success"] and first[4]["failure"] == ""
    again = env.step(GOAL[:2])
    assert again[1:4] == (0.0, True, False)
    np.testing.assert_array_equal(again[0]["pixels"], first[0]["pixels"])
    result = env.episode_result()
    assert (result.is_success, result.failure, result.steps) == (True, None, 1)
    assert result.max_coverage == result.coverage > 0.95


@pytest.fixture(autouse=True)
def no_policy_of_other_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide the policies that other tests of this process hold and drop at any time."""
    monkeypatch.setattr("lerobot_bomb.checkpoints.acting.built_policies", list)


def results_file(path: Path) -> list[dict[str, Any]]:
    """Run two seeds under two conditions, as lerobot-eval does, and return their records."""
    config = BombPushTEnvConfig(perturbations=["none", "goal:3"], results_path=str(path), max_steps=6)
    for group in make_env(config, n_envs=2).values():
        envs: Any = group[0]
        _, info = envs.reset(seed=[5, 6])
        for _ in range(8):
            envs.step(info["block_pose"][:, :2].astype(np.float32))
        envs.close()
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_results_are_a_line_per_episode_that_the_command_summarises(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "results.jsonl"
    rows = results_file(path)
    assert [(row["spec"]["seed"], row["spec"]["perturbations"]) for row in rows] == [
        (5, "none"), (6, "none"), (5, "goal:3"), (6, "goal:3")
    ]  # fmt: skip
    assert all(row["failure"] in list(PushTFailure) and row["steps"] == 6 for row in rows)
    assert all(0 <= row["coverage"] <= row["max_coverage"] <= 1 for row in rows)
    assert [row["levels"] for row in rows] == [{}, {}, {"goal": 3}, {"goal": 3}]
    assert rows[0]["goal_pose"] == [256, 256, np.pi / 4] != rows[2]["goal_pose"]
    assert rows[0]["simulator_versions"]["gym-pusht"]
    assert main(["results", "--strict", "--verbose", str(path)]) == 0
    out = capsys.readouterr().out
    nominal, perturbed = (np.array([row["max_coverage"] for row in rows[i : i + 2]]) for i in (0, 2))
    assert f"max coverage     {nominal.mean():.3f} [" in out
    change = f"max coverage {(perturbed - nominal).mean():+.3f} ["
    assert (
        f"goal:3: 2 pairs, 0 lost, 0 won, p = 1 (exact McNemar test of one condition, not adjusted); {change}"
        in out
    )
    assert "task pusht" in out and "gym-pusht" in out and "MuJoCo" not in out


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"coverage": 1.5}, "coverage=1.5 is impossible"),
        ({"failure": "dropped"}, "failure=\"dropped\" is impossible"),
        ({"goal_pose": [1, 2]}, "goal_pose=[1, 2] is impossible"),
        ({"spec": vars(PushTSpec(5)) | {"perturbations": "camera:3"}}, "'camera' is not an axis"),
        ({"is_success": True}, "is_success=true is impossible with failure="),
    ],
)  # fmt: skip
def test_a_damaged_line_is_named(
    change: dict[str, Any], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "results.jsonl"
    rows = results_file(path)
    path.write_text(json.dumps(rows[0] | change) + "\n")
    assert main(["results", "--strict", str(path)]) == 1
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (
            {"perturbations": ["camera:1"]},
            "'camera' is not an axis; choose one of: table, start, photometric, language, dynamics, object, "
            "goal, goal_marker, all",
        ),
        ({"perturbations": ["goal:6"]}, "--env.perturbations='goal:6': the levels of goal must lie in 0..5"),
        ({"perturbations": "goal:3"}, """--env.perturbations='["none","table:3"]'"""),
        ({"perturbations": ["none", "all:0"]}, "a condition twice"),
        (
            {"instruction": "nothing"},
            "--env.instruction='nothing' is unknown; choose one of: templates",
        ),
        ({"instruction": "none", "perturbations": ["language:2"]}, "--env.instruction=none leaves nothing"),
        ({"task": "PushT-v1"}, "--env.task='PushT-v1' is unknown; choose one of: pusht"),
        ({"fps": 20}, "--env.fps=20 is unknown; choose one of: 10"),
        ({"image_size": 8}, "--env.image_size=8 must lie in 32..512"),
        ({"max_steps": 0}, "--env.max_steps=0 must lie in 1.."),
    ],
)
def test_a_wrong_flag_is_one_clear_line(flags: dict[str, Any], message: str) -> None:
    with pytest.raises(FlagError) as error:
        BombPushTEnvConfig(**flags)
    assert message in str(error.value) and "\n" not in str(error.value)


def test_without_gym_pusht_the_way_out_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lerobot_bomb.pusht.episode.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"needs gym-pusht: pip install 'lerobot_policy_bomb\[pusht\]'"):
        make_env(BombPushTEnvConfig(), n_envs=1)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros(3), r"action has shape \(3,\), expected \(2,\)"),
        (np.array([np.nan, 0.0]), "is not finite"),
        (np.array([1e308, 0.0]), r"action \[1e\+308, 0.0\] is not finite in float32"),
        (np.array(["1", "2"]), "holds <U1, not numbers"),
    ],
)
def test_an_action_that_is_none_is_refused(action: np.ndarray, message: str) -> None:
    env = pusht_env()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        env.step(action)


@pytest.mark.parametrize("condition", ["none", "dynamics:5"])
def test_observations_lie_in_their_space_whatever_the_actions(condition: str) -> None:
    env = pusht_env(condition)
    left_the_board = False
    for sign, size in itertools.product((1, -1), (512, 1024, 1e6, np.finfo(np.float32).max)):
        observation, _ = env.reset(seed=3)
        for step in range(30):
            goal = [sign * size, -sign * size] if step % 10 < 6 else [0, 512]
            assert env.observation_space.contains(observation)
            observation, *_ = env.step(np.array(goal, np.float32))
            left_the_board |= bool(((observation["agent_pos"] < 0) | (observation["agent_pos"] > 512)).any())
    assert left_the_board


def test_an_action_beyond_the_board_is_executed_as_gym_pusht_does() -> None:
    ours, theirs = vector_envs(1, instruction="none"), stock(1, 300)
    ours.reset(seed=[5])
    theirs.reset(seed=[5])
    for action in np.array([[[-512, 1024]], [[600, -3]], [[1000, 513]]], np.float32):
        (seen, *_), (known, *_) = ours.step(action), theirs.step(action)
        np.testing.assert_array_equal(seen["agent_pos"], known["agent_pos"])
    ours.close()
    theirs.close()


def test_an_action_that_arrives_late_is_the_one_that_was_given() -> None:
    ends = []
    for is_reused in (False, True):
        env = pusht_env("dynamics:5")
        env.reset(seed=3)
        action = np.array([100.0, 400.0])
        for step in range(8):
            observation, *_ = env.step(action if is_reused else action.copy())
            action[:] = 50.0 * step
        ends.append(observation["agent_pos"])
    np.testing.assert_array_equal(*ends)


def test_it_is_pickled_and_copied_before_its_first_reset_alone() -> None:
    env = pusht_env("table:3")
    copies = [copy.copy(env), copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    expected = env.reset(seed=2)[0]["pixels"]
    for each in copies:
        np.testing.assert_array_equal(each.reset(seed=2)[0]["pixels"], expected)
        for step in range(3):  # none of them moves another's board
            each.step(np.array([100.0 * step, 0.0]))
    np.testing.assert_array_equal(env.step(np.array([256, 256]))[0]["pixels"], _after_one_step())
    for make_copy in (copy.copy, copy.deepcopy, pickle.dumps):
        with pytest.raises(TypeError, match="a BombPushTEnv that has been reset cannot be pickled or copied"):
            make_copy(env)


def _after_one_step() -> np.ndarray:
    env = pusht_env("table:3")
    env.reset(seed=2)
    return env.step(np.array([256, 256]))[0]["pixels"]


def test_without_seeds_every_environment_runs_an_episode_of_its_own() -> None:
    envs = vector_envs(3)
    assert len({*envs.reset()[1]["seed"]}) == 3
    envs.close()


def test_all_without_a_text_leaves_it_empty() -> None:
    env = pusht_env("all:3", instruction="none")
    env.reset(seed=0)
    assert env.task_description == ""
    assert PushTSpec(0, "none", perturbations="all:3+goal_marker:1").perturbations == "all:3+goal_marker:1"


def test_the_evaluation_s_file_names_every_axis() -> None:
    path = Path(__file__).parents[1] / "configs" / "eval_bomb_pusht.yaml"
    flags = yaml.safe_load(path.read_text())["env"]
    assert flags.pop("type") == "bomb_pusht"
    conditions = {specs[0].perturbations for specs in BombPushTEnvConfig(**flags).groups.values()}
    axes = {f"{axis}:3" for axis in nuisances_of(PUSHT_AXES)}
    assert conditions == {"none", "all:1", "all:3", "all:5", *axes}
