"""`lerobot-bomb view`: what its files show is what happened in the environment."""

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import av
import cv2
import numpy as np
import pytest
from result_rows import row
from rrd_files import Logged, read_rrd, scalars

from lerobot_bomb.bomb.board import BOARD
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.expert import expert_action
from lerobot_bomb.bomb.observation import ACTION_NAMES, STATE_NAMES, RenderOptions
from lerobot_bomb.bomb.privileged_state import PrivilegedState
from lerobot_bomb.commands import main as cli
from lerobot_bomb.envs.rollout import expert_agent, make_env, run_episode
from lerobot_bomb.results.bomb import EpisodeResult
from lerobot_bomb.results.reading import parse_record
from lerobot_bomb.viewing.bomb import bomb_episode
from lerobot_bomb.viewing.episode import ViewedRun, write_episodes
from lerobot_bomb.viewing.rerun_bomb import BombLog
from lerobot_bomb.viewing.sheet import BAR_HEIGHT, title_bar
from lerobot_env_bomb.bomb.env import BombEnv

SPEC = EpisodeSpec(seed=4, target=(3, 2), color="white", fps=5)
OPTIONS = RenderOptions(image_size=64)
FLAGS = ["--seed=4", "--target=[3,2]", "--color=white", "--fps=5", "--image_size=64"]


class Run(NamedTuple):
    """The expert's episode as the environment tells it."""

    instruction: str
    observations: list[dict[str, Any]]
    states: list[PrivilegedState]
    actions: list[np.ndarray]
    infos: list[dict[str, Any]]
    images: list[Any]


@pytest.fixture(scope="module")
def run() -> Run:
    env = make_env(SPEC, OPTIONS)
    observation, info = env.reset(seed=SPEC.seed)
    instruction = env.get_wrapper_attr("task_description")
    observations, infos, actions, images = [observation], [info], [], [env.render()]
    ended = False
    while not ended:
        state = PrivilegedState.from_vector(observation["environment_state"])
        actions.append(expert_action(state))
        observation, _, terminated, truncated, info = env.step(actions[-1])
        observations.append(observation)
        infos.append(info)
        images.append(env.render())
        ended = terminated or truncated
    env.close()
    states = [PrivilegedState.from_vector(o["environment_state"]) for o in observations]
    return Run(instruction, observations, states, actions, infos, images)


@pytest.fixture(scope="module")
def viewed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The two files' path without their suffixes."""
    stem = tmp_path_factory.mktemp("view") / "some" / "episode.1"
    assert cli.main(["view", *FLAGS, f"--output={stem}"]) == 0
    return stem


@pytest.fixture(scope="module")
def logged(viewed: Path) -> Logged:
    return read_rrd(Path(f"{viewed}.rrd"))


def test_cameras_and_state_are_the_environments_to_the_last_moment(logged: Logged, run: Run) -> None:
    for camera in ("workspace", "wrist"):
        rows = logged[f"/camera/{camera}"]
        assert rows.keys() == set(range(len(run.actions) + 1))
        for step, observation in enumerate(run.observations):
            png = np.asarray(rows[step]["EncodedImage:blob"][0], np.uint8)
            shown = cv2.imdecode(png, cv2.IMREAD_COLOR_RGB)
            assert shown is not None
            np.testing.assert_array_equal(shown, observation["pixels"][camera])
    for i, name in enumerate(STATE_NAMES):
        assert scalars(logged, f"/state/{name}") == [float(o["agent_pos"][i]) for o in run.observations]


def test_actions_have_their_names_and_end_before_the_last_moment(logged: Logged, run: Run) -> None:
    for i, name in enumerate(ACTION_NAMES["relative"]):
        assert scalars(logged, f"/action/{name}") == [float(action[i]) for action in run.actions]


def test_the_scene_shows_stones_trace_and_target(logged: Logged, run: Run) -> None:
    path = np.array([state.gripper_xyz for state in run.states], np.float32)
    for step, state in enumerate(run.states):
        stones = logged["/scene/stones"][step]
        np.testing.assert_allclose(
            stones["Ellipsoids3D:centers"], state.stone_xyz[state.stone_in_play], atol=1e-6
        )
        light = [color >> 24 > 128 for color in stones["Ellipsoids3D:colors"]]
        assert light == state.stone_is_white[state.stone_in_play].tolist()
        np.testing.assert_allclose(logged["/scene/gripper"][step]["Points3D:positions"][0], path[step])
        (strip,) = logged["/scene/trace"][step]["LineStrips3D:strips"]
        np.testing.assert_allclose(strip, path[: step + 1])
    (ring,) = logged["/scene/target"][None]["LineStrips3D:strips"]
    np.testing.assert_allclose(np.mean(ring[:-1], axis=0)[:2], BOARD.intersection_xy(3, 2), atol=1e-6)
    (half_size,) = logged["/scene/board"][None]["Boxes3D:half_sizes"]
    np.testing.assert_allclose(half_size, [0.125, 0.125, 0.0025])
    (lines,) = (logged["/scene/board/lines"][None]["LineStrips3D:strips"],)
    assert len(lines) == 10
    assert {tuple(np.round(np.ptp(line, axis=0), 4)) for line in lines} == {(0.18, 0, 0), (0, 0.18, 0)}


def test_words_say_instruction_stages_and_result(logged: Logged, run: Run) -> None:
    assert logged["/instruction"][0]["TextDocument:text"] == [run.instruction]
    stages = [info["stage"] for info in run.infos]
    changes = {k: stage for k, stage in enumerate(stages) if k == 0 or stage != stages[k - 1]}
    assert {step: row["TextLog:text"][0] for step, row in logged["/stage"].items()} == changes
    assert list(changes.values())[-1] == "placed"
    errors = [info["placement_error_mm"] for info in run.infos]
    assert scalars(logged, "/placement_error_mm") == pytest.approx(errors)
    (result,) = logged["/result"].values()
    steps = len(run.actions)
    assert list(logged["/result"]) == [steps]
    assert result["TextDocument:text"][0].startswith(
        f"success after {steps} steps; the stone is {errors[-1]:.1f} mm from the target"
    )


def test_both_timelines_tell_the_same(logged: Logged) -> None:
    for step, logged_row in logged["/camera/wrist"].items():
        assert step is not None
        assert logged_row["time"].total_seconds() == pytest.approx(step / SPEC.fps)


def test_the_viewer_is_told_what_to_show(viewed: Path) -> None:
    from rerun.experimental import RrdReader

    reader = RrdReader(f"{viewed}.rrd")
    (blueprint,) = reader.blueprints()
    origins, timelines = set(), set()
    for chunk in reader.stream(store=blueprint):
        columns = chunk.to_record_batch().to_pydict()
        origins |= {value for cell in columns.get("ViewBlueprint:space_origin", []) for value in cell}
        timelines |= {value for cell in columns.get("TimePanelBlueprint:timeline", []) for value in cell}
    logged = {"camera/workspace", "camera/wrist", "scene", "instruction", "stage", "result"}
    assert origins == {f"{name}" for name in logged | {"action", "state", "placement_error_mm"}}
    assert timelines == {"step"}


def test_the_video_shows_every_moment(viewed: Path, run: Run) -> None:
    with av.open(f"{viewed}.mp4") as video:
        stream = video.streams.video[0]
        assert (stream.codec_context.name, stream.pix_fmt, stream.average_rate) == ("h264", "yuv420p", 5)
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(stream)]
    assert len(frames) == len(run.actions) + 1
    title = title_bar("expert, place, none, seed 4", frames[0].shape[1])
    shown = [frame[BAR_HEIGHT:] for frame in frames]
    for frame, image in zip(shown, run.images, strict=True):
        assert psnr(frame, image) > 30
    assert psnr(shown[-2], run.images[-1]) < psnr(shown[-1], run.images[-1]) - 3
    assert all(psnr(frame[:BAR_HEIGHT], title) > 25 for frame in frames)


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((one / 255.0 - other / 255.0) ** 2)))


def test_the_command_tells_the_outcome_and_overwrites_nothing(
    viewed: Path, run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["view", *FLAGS, f"--output={tmp_path}"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == run.instruction
    assert lines[1].startswith("success after ")
    assert lines[2:] == [
        f"{tmp_path}/place.none_row3-column2_white_expert_seed4{suffix}" for suffix in (".rrd", ".mp4")
    ]
    assert all(Path(line).stat().st_size > 10_000 for line in lines[2:])
    before = {path: path.read_bytes() for path in viewed.parent.iterdir()}
    assert len(before) == 2
    Path(f"{viewed}.rrd").rename(tmp_path / "kept.rrd")  # one of the two is enough
    assert cli.main(["view", *FLAGS, f"--output={viewed}"]) == 1
    assert f"{viewed}.mp4 exists already; name other files with --output" in capsys.readouterr().err
    (tmp_path / "kept.rrd").rename(f"{viewed}.rrd")
    assert {path: path.read_bytes() for path in viewed.parent.iterdir()} == before


def test_random_actions_are_those_of_the_seed_and_fail(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = ["--policy=random", "--fps=2", "--image_size=32", "--control_mode=absolute"]
    actions = []
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        assert cli.main(["view", *flags, f"--seed={seed}", f"--output={tmp_path / name}.rrd"]) == 0
        assert "failed: never_reached after 20 steps" in capsys.readouterr().out
        logged = read_rrd(tmp_path / f"{name}.rrd")
        actions.append(np.array([scalars(logged, f"/action/{name}") for name in ACTION_NAMES["absolute"]]))
        assert "failed: never_reached" in logged["/result"][20]["TextDocument:text"][0]
    assert actions[0].shape == (4, 20)
    assert np.array_equal(actions[0], actions[1])
    assert not np.allclose(actions[0], actions[2])


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from vla0_smol_cases import STATS, make_policy

    from lerobot_policy_bomb.vla0_smol import make_vla0_smol_pre_post_processors

    stats = {**STATS, "action": {"min": STATS["action"]["min"] / 2, "max": STATS["action"]["max"] / 2}}

    folder = tmp_path_factory.mktemp("policy") / "pretrained_model"
    policy = make_policy()
    policy.save_pretrained(folder)
    for processor in make_vla0_smol_pre_post_processors(policy.config, stats):
        processor.save_pretrained(folder)
    return folder


def test_a_checkpoint_acts_as_in_lerobot_eval(
    checkpoint: Path, stock_cli: Callable[..., None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch

    executed: list[np.ndarray] = []
    step = BombEnv.step

    def noting(env: BombEnv, action: np.ndarray) -> Any:
        executed.append(action)
        return step(env, action)

    monkeypatch.setattr(BombEnv, "step", noting)
    own = f"--env.type=bomb --env.fps=2 --env.image_size=64 --policy.path={checkpoint} --seed=3"
    stock_cli(
        "lerobot-eval",
        *own.split(),
        "--eval.n_episodes=1",
        "--eval.batch_size=1",
        f"--output_dir={tmp_path / 'eval'}",
    )
    expected, executed[:] = np.array(executed), []
    torch.manual_seed(0)
    flags = [f"--policy.path={checkpoint}", "--policy.device=cpu", "--fps=2", "--seed=3"]
    assert cli.main(["view", *flags, f"--output={tmp_path / 'seen'}"]) == 0
    assert expected.shape == (20, 4)
    assert np.ptp(expected, axis=0).max() > 0.1  # it does not always do the same
    np.testing.assert_array_equal(np.array(executed), expected)
    assert torch.initial_seed() == 3, "what a policy draws is drawn as in lerobot-eval"
    logged = read_rrd(tmp_path / "seen.rrd")
    shown = np.array([scalars(logged, f"/action/{name}") for name in ACTION_NAMES["relative"]]).T
    np.testing.assert_allclose(shown, expected)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--policy=oracle", "--policy='oracle' is unknown; choose expert or random, or --policy.path=FOLDER"),
        ("--policy=expert --policy.path=bomb:fdvla", "--policy=expert and --policy.path="),
        ("--policy.device=cpu", "--policy.device=cpu needs a checkpoint"),
        ("--policy.path=nowhere", "--policy.path=nowhere: there is no such folder"),
        ("--target=[5,0]", "--env.target=[5, 0] is off the board"),
        ("--target=[0,3] --split=train", "--env.target=[0, 3] is not in --env.split=train"),
        ("--color=red", "--env.color='red' is unknown; choose one of: black, white"),
        ("--robot=ur5", "--env.robot='ur5' is unknown"),
        ("--fps=7", "--env.fps=7 does not divide"),
        ("--image_size=8", "--env.image_size=8 must lie in 32..1024"),
        ("--seed=-1", "--seed=-1 must lie in 0.."),
        ("--perturbations=camra:3", "--env.perturbations='camra:3': 'camra' is not an axis"),
        ("--perturbations=[none,camera:3]", "--env.perturbations=none,camera:3 must be one condition"),
        ("--env.perturbations=camera:7", "--env.perturbations='camera:7': the levels of camera must lie"),
    ],
)
def test_a_bad_flag_is_named_and_nothing_is_written(
    flags: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["view", *flags.split(), f"--output={tmp_path / 'x'}"]) == 1
    error = capsys.readouterr().err
    assert error.startswith(f"lerobot-bomb view: {message}")
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--color=red", "--env.color='red' is unknown"),
        ("--target=[0,3] --split=train", "--env.target=[0, 3] is not in --env.split=train"),
        ("--policy.path=nowhere", "--policy.path=nowhere: there is no such folder"),
        ("", "{path} exists already"),
    ],
)
def test_that_a_file_exists_is_told_last(
    flags: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "x.mp4"
    path.touch()
    assert cli.main(["view", *flags.split(), f"--output={path}"]) == 1
    assert capsys.readouterr().err.startswith(f"lerobot-bomb view: {message.format(path=path)}")
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("fixed", "name"),
    [
        ({}, "place.none_expert_seed4"),
        ({"target": (3, 2), "color": "white"}, "place.none_row3-column2_white_expert_seed4"),
        ({"suite": "goal", "task_id": 0}, "goal.none_task0_expert_seed4"),
    ],
)
def test_files_are_named_after_the_task(fixed: dict[str, Any], name: str) -> None:
    assert bomb_episode(EpisodeSpec(seed=4, **fixed), OPTIONS).name("expert") == name


@pytest.mark.parametrize(
    ("failure", "is_near"),
    [("wrong_intersection", True), ("imprecise", True), ("dropped", False), ("timeout_holding", False)],
)
def test_only_a_stone_that_was_put_down_is_near_an_intersection(failure: str, is_near: bool) -> None:
    result = parse_record(row(0, failure).encode())
    assert isinstance(result, EpisodeResult)
    assert ("nearest to row" in BombLog.describe(result)) == is_near


@pytest.mark.parametrize("task_id", [0, 2])  # into the tray; two stones change places
def test_a_stone_in_the_tray_is_near_no_intersection(
    task_id: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = ["--task=goal", f"--task_ids={task_id}", "--seed=3", "--image_size=32"]
    assert cli.main(["view", *flags, f"--output={tmp_path / 'x'}"]) == 0
    outcome = capsys.readouterr().out.splitlines()[1]
    assert outcome.startswith("success")
    assert outcome.endswith("from the target, in the tray") == (task_id == 0)
    assert ("nearest to row" in outcome) == (task_id == 2)


@pytest.mark.parametrize(
    ("kind", "key", "message"),
    [
        ("output_features", "action", "whose action has shape (7,); that of --env.type=bomb has (4,)"),
        ("input_features", "observation.state", "state has shape (7,); that of --env.type=bomb has (4,)"),
    ],
)
def test_a_checkpoint_of_another_robot_is_refused(
    kind: str,
    key: str,
    message: str,
    checkpoint: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    other = tmp_path / "other"
    shutil.copytree(checkpoint, other)
    config = json.loads((other / "config.json").read_text())
    config[kind][key]["shape"] = [7]
    (other / "config.json").write_text(json.dumps(config))
    assert cli.main(["view", f"--policy.path={other}", f"--output={tmp_path / 'x'}"]) == 1
    error = capsys.readouterr().err
    assert f"--policy.path={other} is a checkpoint whose {key} has shape" in error
    assert message in error
    assert [path.name for path in tmp_path.iterdir()] == ["other"]


def test_an_error_half_way_leaves_no_file(tmp_path: Path) -> None:
    expert = expert_agent()
    calls = iter(range(100))

    def falters(observation: dict[str, Any], instruction: str) -> np.ndarray:
        if next(calls) == 3:
            raise RuntimeError("out of order")
        return expert(observation, instruction)

    with pytest.raises(RuntimeError, match="out of order"):
        run = ViewedRun(bomb_episode(SPEC, OPTIONS), lambda env: nullcontext(falters))
        write_episodes({"faltering": run}, "x", tmp_path / "x.rrd", tmp_path / "x.mp4")
    assert list(tmp_path.iterdir()) == []


def test_a_kill_half_way_leaves_no_file_under_the_final_names(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "lerobot_bomb.commands.main", "view", "--policy=random", "--fps=200"]
    process = subprocess.Popen([*command, "--image_size=32", f"--output={tmp_path / 'x'}"])
    while not any(path.stat().st_size for path in tmp_path.glob(".unfinished-*/x.rrd")):
        assert process.poll() is None
        time.sleep(0.02)
    process.kill()
    process.wait()
    assert [path.name[:12] for path in tmp_path.iterdir()] == [".unfinished-"]


def test_a_moment_is_seen_before_its_action_is_done() -> None:
    env = make_env(SPEC, OPTIONS)
    moments = run_episode(env, SPEC, expert_agent())
    for moment, _ in zip(moments, range(3), strict=False):
        now = env.get_wrapper_attr("privileged_state")()
        np.testing.assert_array_equal(moment.observation["environment_state"], now.to_vector())
    env.close()
