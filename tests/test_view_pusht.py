"""`lerobot-bomb view --env.type=bomb_pusht`: its files show what happened."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from pusht_checkpoints import write_act
from rrd_files import read_rrd, scalars

from lerobot_bomb.commands.main import main

pytest.importorskip("gym_pusht", reason="gym-pusht is not installed: pip install '.[pusht]'")

from bomb_pusht_cases import pusht_env

from lerobot_bomb.envs.rollout import Moment
from lerobot_bomb.pusht.episode import BOARD_PX
from lerobot_bomb.viewing.pusht import PushTView
from lerobot_bomb.viewing.sheet import BAR_HEIGHT
from lerobot_env_bomb.pusht.env import BombPushTEnv

CONDITION, STEPS = "table:3+goal:2", 12
FLAGS = ["view", "--env.type=bomb_pusht", "--seed=3", f"--max_steps={STEPS}", f"--perturbations={CONDITION}"]


def test_the_files_show_the_environment_to_the_last_moment(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*FLAGS, f"--output={tmp_path}"]) == 0
    instruction, outcome, rrd, mp4 = capsys.readouterr().out.splitlines()
    assert rrd == f"{tmp_path}/pusht.table-3.goal-2_random_seed3.rrd"
    logged = read_rrd(Path(rrd))
    env = pusht_env(CONDITION, max_steps=STEPS)
    observation, info = env.reset(seed=3)
    assert instruction == env.task_description == logged["/instruction"][0]["TextDocument:text"][0]
    env.action_space.seed(3)
    images = []
    for step in range(STEPS + 1):
        png = np.asarray(logged["/camera"][step]["EncodedImage:blob"][0], np.uint8)
        shown = cv2.imdecode(png, cv2.IMREAD_COLOR_RGB)
        assert shown is not None
        np.testing.assert_array_equal(shown, observation["pixels"])
        for name, value in zip("xy", observation["agent_pos"], strict=True):
            assert scalars(logged, f"/state/{name}")[step] == value
        for name, value in zip("xy", info["block_pose"], strict=False):
            assert scalars(logged, f"/block/{name}")[step] == value
        turned_deg = np.degrees(info["block_pose"][2] - info["goal_pose"][2])
        shown_deg = scalars(logged, "/turned/degrees")[step]
        assert (shown_deg - turned_deg + 180) % 360 == pytest.approx(180) and abs(shown_deg) <= 180
        images.append(env.render())
        if step == STEPS:
            break
        action = env.action_space.sample()
        assert [scalars(logged, f"/action/{name}")[step] for name in "xy"] == action.tolist()
        observation, *_, info = env.step(action)
        assert logged["/coverage"][step + 1]["Scalars:scalars"][0] == info["coverage"]
    result = env.episode_result()
    assert logged["/result"][STEPS]["TextDocument:text"][0] == outcome
    assert outcome == (
        f"failed: {result.failure} after {STEPS} steps; the block covers {result.coverage:.3f} of the "
        f"target, at its best moment {result.max_coverage:.3f}"
    )
    with av.open(mp4) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert len(frames) == len(images)
    for frame, image in zip(frames, images, strict=True):
        assert np.abs(frame[BAR_HEIGHT:].astype(int) - image).mean() < 4


def test_a_checkpoint_acts_as_in_lerobot_eval(
    stock_cli: Callable[..., None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    executed: list[np.ndarray] = []
    step = BombPushTEnv.step

    def noting(env: BombPushTEnv, action: np.ndarray) -> Any:
        executed.append(action)
        return step(env, action)

    monkeypatch.setattr(BombPushTEnv, "step", noting)
    policy = f"--policy.path={write_act(tmp_path / 'act')}"
    own = f"--env.type=bomb_pusht --env.max_steps={STEPS} --env.instruction=none --seed=3"
    stock_cli(
        "lerobot-eval",
        policy,
        *own.split(),
        "--eval.n_episodes=1",
        "--eval.batch_size=1",
        f"--output_dir={tmp_path / 'eval'}",
    )
    expected, executed[:] = np.array(executed), []
    flags = ["view", "--env.type=bomb_pusht", policy, "--policy.device=cpu", "--seed=3", "--instruction=none"]
    assert main([*flags, f"--max_steps={STEPS}", f"--output={tmp_path / 'seen'}"]) == 0
    assert expected.shape == (STEPS, 2)
    np.testing.assert_array_equal(np.array(executed), expected)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--policy=expert", "--policy='expert' is unknown; choose random, or --policy.path=FOLDER"),
        ("--robot=fetch", "--env.robot=fetch is a flag of --env.type=bomb only; drop it"),
        ("--image_size=8", "--env.image_size=8 must lie in 32..512"),
        ("--max_steps=0", "--env.max_steps=0 must lie in 1.."),
        ("--instruction=some", "--env.instruction='some' is unknown; choose one of: templates, none"),
        ("--perturbations=camera:3", "--env.perturbations='camera:3': 'camera' is not an axis"),
        ("--perturbations=none,goal:3", "--env.perturbations=none,goal:3 must be one condition"),
        ("--env.type=pusht", "--env.type='pusht' is unknown; choose one of: bomb, bomb_pusht"),
        ("--env.type=bomb", "--env.max_steps=12 is a flag of --env.type=bomb_pusht only; drop it"),
    ],
)
def test_a_bad_flag_is_named_and_nothing_is_written(
    flags: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*FLAGS[:-1], *flags.split(), f"--output={tmp_path / 'x'}"]) == 1
    error = capsys.readouterr().err
    assert error.startswith(f"lerobot-bomb view: {message}")
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_checkpoint_of_other_images_is_told_the_flag(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    policy = f"--policy.path={write_act(tmp_path / 'act', image_size=64)}"
    assert main([*FLAGS, policy, "--image_size=96", f"--output={tmp_path / 'x'}"]) == 1
    error = capsys.readouterr().err
    assert "reads images of 64x64 pixels; this environment has --env.image_size=96: " in error
    assert "evaluate with --env.image_size=64, or override with --env.ignore_checkpoint=true" in error
    wide = ["--image_size=96", "--ignore_checkpoint", f"--output={tmp_path / 'x'}"]
    assert main([*FLAGS, policy, *wide]) == 0
    assert main([*FLAGS, policy, f"--output={tmp_path / 'own'}"]) == 0  # images of the size that it reads


def test_a_filmstrip_marks_the_target_and_what_is_covered() -> None:
    env = pusht_env("goal:3")
    observation, info = env.reset(seed=3)
    first = PushTView().shot(env, Moment(0, "", observation, info, None))
    assert first.marks["camera"].words == {}  # nothing is measured before a step
    observation, *_, info = env.step(np.array([256.0, 256.0], np.float32))
    shot = PushTView().shot(env, Moment(1, "", observation, info, None))
    marks, side = shot.marks["camera"], shot.images["camera"].shape[0]
    assert [*marks.words] == [f"covered: {info['coverage']:.0%}"]
    (outline,) = marks.outlines
    corners = np.array(outline, np.float32) * (BOARD_PX / side)
    # a bar of 120 x 30 pixels on a stem of 30 x 90
    assert len(corners) == 8 and cv2.contourArea(corners) == pytest.approx(6300, abs=5)
    x, y, angle_rad = info["goal_pose"]
    end = np.array([x, y]) + 120 * np.array([-np.sin(angle_rad), np.cos(angle_rad)])
    assert np.linalg.norm(corners - end, axis=1).min() == pytest.approx(15, abs=0.1)  # half the stem's width
    env.close()
