"""BOMB in PhysX: the same episodes, solved by the same expert, kept apart from MuJoCo's in results."""

import importlib.util
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from lerobot_bomb.bomb.board import NUM_STONES
from lerobot_bomb.bomb.episode import PHYSICS_HZ, EpisodeSpec
from lerobot_bomb.bomb.observation import ENVIRONMENT_STATE, PIXELS, RenderOptions
from lerobot_bomb.bomb.suites import OWN_SUITES
from lerobot_bomb.commands.main import main
from lerobot_bomb.data.recording import Recording
from lerobot_bomb.envs.rollout import Moment, expert_agent, make_env, run_episode
from lerobot_bomb.results.bomb import EpisodeResult
from lerobot_bomb.results.comparison import compare
from lerobot_bomb.results.groups import groups_of
from lerobot_bomb.results.reading import read_records
from lerobot_env_bomb.bomb.hand import PAD_SIDES
from lerobot_env_bomb.bomb.model import stone_name
from lerobot_env_bomb.bomb.perturb import sample_episode
from lerobot_env_bomb.bomb.scene import Scene

SPEC = EpisodeSpec(seed=1000, simulator="sapien")
OPTIONS = RenderOptions(image_size=32)


def run(spec: EpisodeSpec) -> tuple[list[Moment], EpisodeResult]:
    env = make_env(spec, OPTIONS)
    moments = list(run_episode(env, spec, expert_agent()))
    result = env.get_wrapper_attr("episode_result")()
    env.close()
    return moments, result


@pytest.mark.parametrize(
    "spec",
    [
        *(replace(SPEC, suite=suite) for suite in OWN_SUITES),
        replace(SPEC, robot="fetch"),
        replace(SPEC, perturbations="all:5"),
        replace(SPEC, control_mode="absolute", fps=20),
    ],
    ids=lambda spec: f"{spec.suite}-{spec.robot}-{spec.perturbations}-{spec.fps}",
)
def test_the_expert_solves_an_episode(spec: EpisodeSpec) -> None:
    _, result = run(spec)
    assert result.is_success
    assert result.sapien_version == "3.0.3"
    assert spec.perturbations != "none" or result.placement_error_mm < 3


def test_an_episode_starts_as_in_mujoco_and_repeats_bit_for_bit() -> None:
    (first, *_), _ = run(replace(SPEC, simulator="mujoco"))
    moments, result = run(SPEC)
    again, same = run(SPEC)
    for camera, image in first.observation[PIXELS].items():
        np.testing.assert_array_equal(image, moments[0].observation[PIXELS][camera])
    assert result == same
    assert len(moments) == len(again)
    for before, after in zip(moments, again, strict=True):
        np.testing.assert_array_equal(before.observation["agent_pos"], after.observation["agent_pos"])
        np.testing.assert_array_equal(before.observation[PIXELS]["wrist"], after.observation[PIXELS]["wrist"])


def test_other_processes_and_vector_envs_give_the_same_bits() -> None:
    moments, _ = run(SPEC)
    actions = [moment.action for moment in moments if moment.action is not None]
    make = partial(make_env, SPEC, OPTIONS)
    envs = [
        SyncVectorEnv([make, make], autoreset_mode=AutoresetMode.DISABLED),
        AsyncVectorEnv([make], context="forkserver", autoreset_mode=AutoresetMode.DISABLED),
    ]
    for env in envs:
        observation, _ = env.reset(seed=[SPEC.seed] * env.num_envs)
        for moment, action in zip(moments, actions, strict=False):
            for states in observation[ENVIRONMENT_STATE]:
                np.testing.assert_array_equal(states, moment.observation[ENVIRONMENT_STATE])
            observation, *_ = env.step(np.stack([action] * env.num_envs))
        env.close()


def test_sizes_masses_and_frictions_are_those_of_the_perturbed_model() -> None:
    spec = replace(SPEC, perturbations="dynamics:5+object:5")
    episode = sample_episode(spec)
    scene = Scene("scara", "sapien")
    scene.reset(episode.layout, episode.perturbation.model_edits)
    stones = scene._physics._stones  # pyright: ignore[reportAttributeAccessIssue]
    assert [*stones] == [*np.flatnonzero(episode.layout.stone_in_play)]
    nominal = Scene().model.geom(stone_name(0))
    for index, stone in stones.items():
        body, rim = scene.model.body(stone_name(index)), scene.model.geom(stone_name(index))
        (shape,) = stone.collision_shapes
        assert stone.mass == pytest.approx(body.mass[0], rel=1e-6)
        np.testing.assert_allclose(stone.inertia, body.inertia, rtol=1e-5)
        assert [shape.radius, shape.half_length] == pytest.approx(rim.size[:2], rel=1e-6)
        assert shape.physical_material.static_friction == pytest.approx(rim.friction[0], rel=1e-6)
        assert rim.friction[0] != nominal.friction[0]
        assert rim.size[0] != nominal.size[0]


@pytest.mark.parametrize("robot", ["scara", "fetch"])
def test_pads_are_where_mujoco_has_them_and_touch_what_they_close_on(robot: str) -> None:
    episode = sample_episode(replace(SPEC, robot=robot))
    scene = Scene(robot, "sapien")
    scene.reset(episode.layout)
    stone = episode.aims[0].stone
    above = np.array([*episode.layout.stone_xy[stone], 0.1])
    for target, is_open in [(above, True), (above - [0, 0, 0.094], True), (above - [0, 0, 0.094], False)]:
        for _ in range(8):
            scene.move(target, is_open, PHYSICS_HZ // 10)
    touched = scene.measure().stone_touched
    assert touched[stone].all()
    assert touched.sum() == 2
    physics = scene._physics
    for side, link in zip(PAD_SIDES, physics._pads, strict=True):  # pyright: ignore[reportAttributeAccessIssue]
        (shape,) = link.collision_shapes
        center = (link.entity_pose * shape.local_pose).p
        np.testing.assert_allclose(center, scene.data.geom(f"{side}_pad").xpos, atol=1e-5)


def test_nothing_moves_without_a_command() -> None:
    episode = sample_episode(SPEC)
    scene = Scene("scara", "sapien")
    scene.reset(episode.layout)
    before = scene.measure()
    for _ in range(20):
        scene.move(episode.layout.gripper_xyz, True, PHYSICS_HZ // 10)
    after = scene.measure()
    np.testing.assert_allclose(after.stone_xyz, before.stone_xyz, atol=1e-4)
    np.testing.assert_allclose(after.gripper_xyz, before.gripper_xyz, atol=1e-4)
    assert after.stone_touched.shape == (NUM_STONES, 2)
    assert not after.stone_touched.any()


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Records of three episodes in either simulator."""
    path = tmp_path_factory.mktemp("both") / "both.jsonl"
    records = [
        run(replace(SPEC, seed=1000 + number, simulator=simulator))[1]
        for simulator in ("mujoco", "sapien")
        for number in range(3)
    ]
    path.write_text("".join(f"{record.to_json()}\n" for record in records))
    return path


def test_simulators_are_pooled_by_nobody_and_paired_on_request(
    both: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    records = [*read_records(both)[0].values()]
    assert len(groups_of(records)) == 2
    with pytest.raises(ValueError, match="they differ in simulator"):
        compare(records[:3], records[3:])
    assert main(["compare", str(both), "--across=simulator"]) == 0
    output = capsys.readouterr().out
    assert "simulator mujoco, B is " in output
    assert "they tie (3 successes each in 3 pairs)" in output


def test_wrong_requests_are_refused(
    both: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(
        ValueError, match=r"--env\.simulator='drake' is unknown; choose one of: mujoco, sapien"
    ):
        replace(SPEC, simulator="drake")
    with pytest.raises(ValueError, match=r"--env\.simulator=sapien: nothing moves in static scenes"):
        Recording("test/static", episodes=1, static=100, simulator="sapien")
    assert main(["compare", str(both), "--across=robot"]) == 1
    assert "--across='robot' is unknown; choose one of: simulator, render_preset" in capsys.readouterr().err
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"needs SAPIEN, which is not installed: pip install"):
        make_env(SPEC, OPTIONS)
