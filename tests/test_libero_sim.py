"""A recording of LIBERO's simulator, converted, is what LeRobot's environment shows: pixels, state, task.

Needs hf-libero and its assets of one suite; skips without.
"""

import importlib
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from libero_cases import IMAGE_SIZE, REPO_ID, SUITE, Demonstration, write_file
from stock_policies import flags_of

from lerobot_bomb.commands import main as cli
from lerobot_bomb.data.libero_conversion import KEYS, convert_libero
from lerobot_bomb.data.libero_hdf5 import instruction
from lerobot_bomb.libero.assets import SUITES, Libero, prepare_libero
from lerobot_bomb.libero.orientation import ORIENTATIONS, SAME, orientation

OPEN, CLOSE = -1.0, 1.0
ACTIONS = np.array(
    [
        [0.5, 0, 0, 0, 0, 0, OPEN],
        [0.5, 0.3, -0.4, 0, 0, 0, OPEN],
        [0, 0.3, -0.4, 0.2, 0, 0.3, OPEN],
        [0, 0, 0, 0, 0, 0, CLOSE],
        [0, 0, 0.5, 0, 0.2, 0, CLOSE],
        [0, 0, 0.5, 0, 0, 0, CLOSE],
    ]
)


@dataclass(frozen=True)
class Recording:
    demonstration: Demonstration  # what LIBERO's own script would write
    seen: list[dict[str, Any]]  # what lerobot-eval gives a policy at the same moments
    task: str  # the instruction that it gives
    bddl: str  # the name of the task's file


@pytest.fixture(scope="module")
def recording(libero_with_assets: Libero) -> Recording:
    prepare_libero([SUITE])
    return record()


def record() -> Recording:
    """LeRobot's environment, and beside it the raw observations of the simulator that it holds."""
    from lerobot.envs.factory import make_env, make_env_config, make_env_pre_post_processors
    from lerobot.envs.utils import preprocess_observation
    from lerobot.policies.act.configuration_act import ACTConfig

    importlib.import_module("lerobot_env_bomb.shared.backend").ensure_gl_backend()
    size = {"observation_height": IMAGE_SIZE, "observation_width": IMAGE_SIZE}
    config = make_env_config("libero", task=SUITE, task_ids=[0], hard_reset=False, **size)
    vector: Any = make_env(config, n_envs=1)[SUITE][0]
    to_policy, _ = make_env_pre_post_processors(config, ACTConfig())
    observation, _ = vector.reset(seed=0)
    env = vector.envs[0].unwrapped
    raw, seen = [], []
    for action in [None, *ACTIONS]:
        if action is not None:
            observation, *_ = vector.step(action[None].astype(np.float32))
        raw.append({**env._env.env._get_observations(), "simulator": env._env.sim.get_state().flatten()})
        seen.append(to_policy(preprocess_observation(observation)))
    task, bddl = env.task_description, Path(env._task_bddl_file).stem
    vector.close()
    return Recording(demonstration_from(raw), seen, task, bddl)


def demonstration_from(raw: list[dict[str, Any]]) -> Demonstration:
    from robosuite.utils.transform_utils import quat2axisangle

    def stacked(name: str) -> np.ndarray:
        return np.stack([moment[name] for moment in raw])

    turns = np.stack([quat2axisangle(moment["robot0_eef_quat"]) for moment in raw])
    return Demonstration(
        (stacked("agentview_image"), stacked("robot0_eye_in_hand_image")),
        np.concatenate([stacked("robot0_eef_pos"), turns], axis=1),
        stacked("robot0_joint_pos"),
        stacked("robot0_gripper_qpos"),
        ACTIONS,
        stacked("simulator"),
    )


@pytest.fixture(scope="module")
def rows(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> list[Any]:
    """The recording as a file of LIBERO's layout, converted."""
    from lerobot.datasets import LeRobotDataset

    folder = tmp_path_factory.mktemp("libero")
    file = write_file(folder / f"{recording.bddl}_demo.hdf5", [recording.demonstration], task=recording.bddl)
    convert_libero(file, REPO_ID, folder / "x", images=True)
    dataset: Any = LeRobotDataset(REPO_ID, root=folder / "x", video_backend="pyav")
    assert {dataset[index]["task"] for index in range(len(dataset))} == {recording.task}
    return list(dataset.hf_dataset.with_format(None))


def shown(recording: Recording, moment: int, key: str) -> np.ndarray:
    """(H, W, 3) uint8, as a policy is given it."""
    pixels = recording.seen[moment][key][0].numpy().transpose(1, 2, 0)
    return np.round(pixels * 255).astype(np.uint8)


def test_every_frame_is_what_a_policy_sees_before_the_action(recording: Recording, rows: list[Any]) -> None:
    assert len(rows) == len(ACTIONS) - 1
    for moment, row in enumerate(rows, start=1):
        np.testing.assert_array_equal(np.float32(row["action"]), np.float32(ACTIONS[moment]))
        state = recording.seen[moment]["observation.state"][0].numpy()
        np.testing.assert_allclose(row["observation.state"], state, atol=1e-6)
        for key in KEYS:
            np.testing.assert_array_equal(np.asarray(row[key]), shown(recording, moment, key))


def test_plus_one_closes_the_gripper_and_minus_one_opens_it(rows: list[Any]) -> None:
    opening = np.array([row["observation.state"][6] - row["observation.state"][7] for row in rows])
    commands = np.array([row["action"][6] for row in rows])
    changes = np.diff(opening)
    assert (changes[commands[:-1] == OPEN][1:] >= 0).all()
    assert changes[commands[:-1] == CLOSE].sum() < -0.001  # metres


@pytest.mark.parametrize("name", ORIENTATIONS)
@pytest.mark.parametrize("key", KEYS)
def test_the_orientation_that_images_of_other_moments_have_is_told(
    name: str, key: str, recording: Recording
) -> None:
    vertical, horizontal = ORIENTATIONS[name]
    images = np.stack([shown(recording, moment, key)[::vertical, ::horizontal] for moment in (4, 5)])
    expected = np.stack([shown(recording, moment, key) for moment in (0, 1)])
    assert orientation(images, expected) == name


def test_images_that_were_not_turned_are_told(recording: Recording) -> None:
    raw = recording.demonstration.images[0]
    expected = np.stack([shown(recording, moment, KEYS[0]) for moment in range(3)])
    assert orientation(raw, expected).startswith("turned by 180 degrees")
    assert orientation(raw[:, ::-1, ::-1], expected) == SAME
    with pytest.raises(ValueError, match=r"--env\.observation_height"):
        orientation(raw[:, ::2, ::2], expected)


ONE_STEP = ["--policy.type=act", "--policy.push_to_hub=false", "--batch_size=2", "--num_workers=0"]
ONE_STEP += ["--steps=1", "--save_freq=1"]
TURNED = "that are turned by 180 degrees, as the simulator gives them"


@pytest.mark.long
@pytest.mark.parametrize(("convention", "is_told"), [("opengl", False), ("lerobot", True)])
def test_a_policy_that_was_trained_on_the_other_orientation_is_told(
    convention: str,
    is_told: bool,
    recording: Recording,
    stock_cli: Callable[..., None],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """`lerobot` says that the file's images are turned already, which is not so: they stay as they are."""
    file = write_file(
        tmp_path / f"{recording.bddl}_demo.hdf5", [recording.demonstration], task=recording.bddl
    )
    data, flags = tmp_path / "data", [f"--repo_id={REPO_ID}", f"--image_convention={convention}", "--images"]
    assert cli.main(["convert", "libero-hdf5", str(file), *flags, f"--root={data}"]) == 0
    where = [f"--dataset.repo_id={REPO_ID}", f"--dataset.root={data}", f"--output_dir={tmp_path / 'train'}"]
    stock_cli("lerobot-train", *ONE_STEP, *flags_of("act"), *where)

    checkpoint = tmp_path / "train" / "checkpoints" / "last" / "pretrained_model"
    flags = [f"--policy.path={checkpoint}", "--policy.device=cpu", f"--output_dir={tmp_path / 'eval'}"]
    flags += ["--env.type=bomb_libero", f"--env.task={SUITE}", "--env.task_ids=[0]", "--env.episode_length=2"]
    flags += ["--eval.n_episodes=1", "--eval.batch_size=1", "--eval.use_async_envs=false"]
    small = [f"--env.observation_{side}={IMAGE_SIZE}" for side in ("height", "width")]
    capsys.readouterr()
    stock_cli("lerobot-eval", *flags, *small)
    told = f"the checkpoint {checkpoint} was trained on images of {data} {TURNED}"
    assert capsys.readouterr().err.count(told) == is_told
    size = f"evaluate with {' '.join(small)}, or override with --env.ignore_checkpoint=true"
    with pytest.raises(ValueError, match=f"{re.escape(size)}$"):
        stock_cli("lerobot-eval", *flags)


def test_every_task_is_named_as_hf_libero_names_it(libero: Libero) -> None:
    from libero.libero.benchmark import get_benchmark_dict  # after the config file was written

    tasks = [task for suite in SUITES for task in get_benchmark_dict()[suite]().tasks]
    assert len(tasks) == 130
    assert [instruction(Path(task.bddl_file).stem) for task in tasks] == [task.language for task in tasks]
