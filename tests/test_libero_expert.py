"""The scripted expert of LIBERO: what it reads, which way it goes, what it refuses; without a simulator."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lerobot.envs import make_env_config
from lerobot.policies import make_policy
from lerobot.policies.factory import make_policy_config

from lerobot_bomb.checkpoints.acting import acting
from lerobot_bomb.commands import main as cli
from lerobot_bomb.libero.assets import Libero
from lerobot_bomb.libero.expert import LiberoState, libero_expert_action
from lerobot_bomb.libero.goals import check_predicates, expert_order
from lerobot_env_bomb.shared.rotations import rotation
from lerobot_policy_bomb.bomb_expert.configuration_bomb_expert import BombExpertConfig

TASK = "(define (problem X) (:init (On a b)) (:goal (And ({} a b) (Open c))))"
RECORD = ["record", "--env.type=bomb_libero", "--repo_id=test/x", "--episodes=1"]


def state(motion_m: np.ndarray, turn: np.ndarray, **others: float | np.ndarray) -> LiberoState:
    """The gripper at a drawn pose, its target this far away."""
    here = rotation(np.array([0.6, 0.8, 0.0]), 0.7)
    xyz = np.array([0.1, -0.2, 1.0])
    values = {"gripper": -1.0, **others}
    return LiberoState(xyz, here, xyz + motion_m, turn @ here, **values)  # pyright: ignore[reportArgumentType]


def test_state_survives_its_vector() -> None:
    given = state(np.ones(3), np.eye(3), speed=0.5, pending_m=np.array([1.0, 2, 3]))
    back = LiberoState.from_vector(given.to_vector())
    for name in vars(given):
        np.testing.assert_allclose(getattr(back, name), getattr(given, name), rtol=1e-6)


def test_state_of_another_length_is_refused() -> None:
    with pytest.raises(ValueError, match=r"shape \(31,\), expected \(32,\)"):
        LiberoState.from_vector(np.zeros(31))


@given(st.integers(0, 2), st.floats(-0.3, 0.3), st.floats(-3.1, 3.1))
def test_action_points_to_the_target(axis: int, way_m: float, turn_rad: float) -> None:
    unit = np.eye(3)[axis]
    action = libero_expert_action(state(way_m * unit, rotation(unit, turn_rad)))
    motion, turn = np.clip(1.4 * way_m / 0.05, -1, 1), np.clip(1.4 * turn_rad / 0.5, -1, 1)
    np.testing.assert_allclose(action, [*(motion * unit), *(turn * unit), -1], atol=2e-3)


def test_half_a_turn_is_turned() -> None:
    action = libero_expert_action(state(np.zeros(3), rotation(np.array([0, 0, 1.0]), np.pi)))
    assert abs(action[5]) == pytest.approx(1)


def test_pending_motion_shortens_the_step() -> None:
    pending_m = np.array([0.02, 0, 0])
    action = libero_expert_action(state(np.array([0.01, 0, 0]), np.eye(3), pending_m=pending_m))
    assert action[0] == pytest.approx(1.4 * (0.01 - 0.35 * 0.02) / 0.05)


def test_goals_open_first_and_close_last() -> None:
    goals = [["close", "a"], ["in", "b", "a"], ["open", "a"]]
    assert [goal[0] for goal in expert_order(goals)] == ["open", "in", "close"]


def test_unknown_predicates_are_named(tmp_path: Path) -> None:
    path = tmp_path / "task.bddl"
    path.write_text(TASK.format("Stack"))
    with pytest.raises(
        ValueError, match=r"task\.bddl: the expert does not know the predicate stack, only open"
    ):
        check_predicates(path)
    path.write_text(TASK.format("On"))
    check_predicates(path)


def test_every_task_asks_for_known_predicates(libero: Libero) -> None:
    files = sorted(libero.task_folders()["bddl_files"].rglob("*.bddl"))
    assert len(files) >= 130
    for path in files:
        check_predicates(path)


@pytest.mark.parametrize(("flag", "value"), [("control_mode", "absolute"), ("fps", 10)])
def test_other_controllers_are_refused(flag: str, value: str | int) -> None:
    config = make_env_config("bomb_libero", **{flag: value})
    with (
        acting(BombExpertConfig()),
        pytest.raises(ValueError, match=rf"--env\.{flag}={value}: the expert acts"),
    ):
        config.get_env_processors()


def test_expert_acts_on_seven_numbers() -> None:
    policy = make_policy(
        make_policy_config("bomb_expert", device="cpu"), env_cfg=make_env_config("bomb_libero")
    )
    assert policy.config.output_features["action"].shape == (7,)  # pyright: ignore[reportOptionalSubscript]


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("--robot=fetch", "--robot is of --env.type=bomb"),
        ("--static=1", "--static is of --env.type=bomb"),
        ("--noise=2", "must lie in 0..1"),
        ("--task=libero_x", "libero_spatial, libero_object"),
        ("--task_ids=[10]", "has no task 10, only 0..9"),
        ("--perturbations=camera:3,camera:3", "names something twice"),
        ("--perturbations=haze:1", "table, reflectance"),
        ("--env.observation_height=0", "at least 1"),
    ],
)
def test_wrong_record_flags(flag: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    flags = [each for each in RECORD if not (flag.startswith("--static") and each.startswith("--episodes"))]
    assert cli.main([*flags, flag]) == 1
    assert message in capsys.readouterr().err


def test_bomb_refuses_flags_of_libero(capsys: pytest.CaptureFixture[str]) -> None:
    flags = ["record", "--repo_id=test/x", "--episodes=1", "--env.observation_width=64"]
    assert cli.main(flags) == 1
    assert "--env.observation_width=64 is of --env.type=bomb_libero" in capsys.readouterr().err
