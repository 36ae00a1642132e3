"""Perturbed episodes as a policy meets them: images, motion, and what must not show."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.expert import expert_action
from lerobot_bomb.bomb.observation import CAMERAS, MAX_STEP_M, RenderOptions
from lerobot_bomb.bomb.perturbations import AXES, NUISANCES
from lerobot_bomb.bomb.privileged_state import PrivilegedState
from lerobot_bomb.bomb.suites.place import targets_of
from lerobot_env_bomb.bomb.env import BombEnv
from lerobot_env_bomb.bomb.perturb import sample_episode
from lerobot_env_bomb.bomb.scene import HIDDEN_RGBA

SIZE = 64
VISUAL = [axis for axis in AXES if "images" in AXES[axis].changes]
MOTIONS = np.random.default_rng(0).uniform(-0.4, 0.4, (4, 4)).astype(np.float32)  # of the gripper, aimless

type Under = Callable[..., BombEnv]


@pytest.fixture(scope="module")
def under() -> Iterator[Under]:
    """Yield under(condition, **spec): an environment whose next reset is under it.

    There is one for each control mode, as compiling a model and opening OpenGL take longer than a test.
    """
    envs: dict[str, BombEnv] = {}

    def use(condition: str = "none", **spec: Any) -> BombEnv:
        wanted = EpisodeSpec(seed=0, perturbations=condition, **spec)
        if wanted.control_mode not in envs:
            envs[wanted.control_mode] = BombEnv(wanted, RenderOptions(SIZE))
        envs[wanted.control_mode]._spec = wanted
        return envs[wanted.control_mode]

    yield use
    for env in envs.values():
        env.close()


def images(env: BombEnv, seed: int) -> np.ndarray:
    """(2, SIZE, SIZE, 3) of both cameras at the start, as int."""
    observation, _ = env.reset(seed=seed)
    return np.stack([observation["pixels"][camera] for camera in CAMERAS]).astype(int)


def episode_of(env: BombEnv, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """States and images of the same few motions."""
    observation, _ = env.reset(seed=seed)
    observations = [observation, *(env.step(motion)[0] for motion in MOTIONS)]
    states = np.stack([o["environment_state"] for o in observations])
    return states, np.stack([[o["pixels"][camera] for camera in CAMERAS] for o in observations])


@pytest.mark.parametrize("axis", [*VISUAL, "all"])
def test_each_level_changes_the_images_more_than_the_one_below(under: Under, axis: str) -> None:
    changes = []
    for seed in range(8):
        nominal, *perturbed = (images(under(f"{axis}:{level}"), seed) for level in range(6))
        changes.append([abs(image - nominal).mean() for image in perturbed])
    mean = np.mean(changes, axis=0)
    assert mean[0] > 0 and (np.diff(mean) > 0).all(), mean


@pytest.mark.parametrize("axis", list(AXES))
def test_an_axis_changes_images_motion_and_instruction_only_as_it_says(under: Under, axis: str) -> None:
    env = under()
    (states, images), instruction = episode_of(env, 3), env.task_description
    perturbed_states, perturbed_images = episode_of(under(f"{axis}:5"), 3)
    changes = AXES[axis].changes
    assert np.array_equal(states, perturbed_states) == (not {"scene", "dynamics"} & set(changes))
    assert np.array_equal(images[0], perturbed_images[0]) == ("images" not in changes)
    assert (instruction == env.task_description) == ("instruction" not in changes)
    if changes == ("instruction",):
        np.testing.assert_array_equal(images, perturbed_images)


@pytest.mark.parametrize("condition", ["none", *(f"{axis}:5" for axis in AXES), "all:3", "all:5"])
def test_no_image_tells_the_target_before_a_stone_is_moved(under: Under, condition: str) -> None:
    """Targets that are free and legal on the same board look the same, but where a marker shows them."""
    seed = 3
    boards: dict[bytes, list[tuple[int, int]]] = {}
    for target in targets_of("all"):
        spec = EpisodeSpec(seed=seed, target=target, color="white", perturbations=condition)
        layout = sample_episode(spec).layout
        boards.setdefault(layout.stone_xy.tobytes() + layout.stone_is_white.tobytes(), []).append(target)
    targets = max(boards.values(), key=len)
    assert len(targets) >= 5
    views = [
        episode_of(under(condition, target=target, color="white"), seed)[1]
        for target in targets[:: len(targets) // 3]
    ]
    differ = any(not np.array_equal(views[0], view) for view in views[1:])
    assert differ == (condition == "goal_marker:5")


@pytest.mark.parametrize("condition", ["none", *(f"{axis}:5" for axis in NUISANCES), "all:5"])
def test_the_stone_to_be_moved_can_be_seen(under: Under, condition: str) -> None:
    """Images with and without it differ in grey levels, by the clearest dozen pixels."""
    env = under(condition)
    for seed in range(6):
        shown = images(env, seed)
        scene = env._run.scene
        scene.model.geom("stone_0_visual").rgba = HIDDEN_RGBA
        hidden = np.stack([env._draw(camera, SIZE) for camera in CAMERAS]).astype(int)
        change = np.sort(abs(shown - hidden).max(axis=-1).ravel())[-12:]
        assert change.mean() > (12 if condition == "all:5" else 40), (seed, change)


@pytest.mark.parametrize("control_mode", ["relative", "absolute"])
def test_latency_executes_an_action_one_step_late(under: Under, control_mode: str) -> None:
    env = under("dynamics:5", control_mode=control_mode)
    observation, _ = env.reset(seed=2)
    start = PrivilegedState.from_vector(observation["environment_state"])
    assert start.pending_gripper == 1.0 and not start.pending_motion_m.any()
    up = np.array([0, 0, 0.5, -1.0])
    if control_mode == "absolute":
        up = np.array([*start.gripper_xyz[:2], start.gripper_xyz[2] + 0.5 * MAX_STEP_M, -1.0])
    after_one, after_two = (
        PrivilegedState.from_vector(env.step(up)[0]["environment_state"]) for _ in range(2)
    )
    above_xyz = start.gripper_xyz + np.array([0, 0, 0.02])
    noise_m = 4 * 0.05 * MAX_STEP_M
    assert abs(after_one.gripper_xyz - start.gripper_xyz).max() < noise_m
    np.testing.assert_allclose(after_one.gripper_xyz + after_one.pending_motion_m, above_xyz, atol=noise_m)
    assert after_one.finger_opening > 0.04 > after_two.finger_opening
    assert after_one.pending_gripper == -1.0
    np.testing.assert_allclose(after_two.gripper_xyz, above_xyz, atol=2 * noise_m)


def test_action_noise_is_the_seed_s_and_as_large_as_stated(under: Under) -> None:
    env = under("dynamics:3", control_mode="absolute")  # no latency yet
    observation, _ = env.reset(seed=0)
    here = np.array([*observation["agent_pos"][:3], 1.0])
    offsets = np.array([env.step(here)[0]["agent_pos"][:3] - here[:3] for _ in range(60)])
    np.testing.assert_allclose(offsets.std(axis=0), 0.03 * MAX_STEP_M, rtol=0.4)
    env.reset(seed=0)
    again = np.array([env.step(here)[0]["agent_pos"][:3] - here[:3] for _ in range(60)])
    np.testing.assert_array_equal(offsets, again)


@pytest.mark.parametrize("condition", ["all:5", "dynamics:5", "object:5", "start:5"])
@pytest.mark.parametrize("control_mode", ["relative", "absolute"])
def test_the_expert_places_stones_under_perturbation(under: Under, condition: str, control_mode: str) -> None:
    env = under(condition, control_mode=control_mode)
    for seed in (1, 29):
        observation, info = env.reset(seed=seed)
        ended = False
        while not ended:
            state = PrivilegedState.from_vector(observation["environment_state"])
            observation, _, terminated, truncated, info = env.step(expert_action(state))
            ended = terminated or truncated
        assert info["is_success"], (seed, info)
        assert env.episode_result().levels == sample_episode(env.episode_result().spec).perturbation.levels


def test_the_target_mask_is_as_large_as_stones(under: Under) -> None:
    env = under("object:5", target=(2, 2))
    num_pixels: dict[float, int] = {}  # by radius: 11 or 15 mm
    for seed in range(8):
        env.reset(seed=seed)
        radius_m = env.privileged_state().stone_radius_m
        num_pixels[radius_m] = int(env.object_masks()["workspace"]["target"].sum())
    small, large = (num_pixels[radius_m] for radius_m in sorted(num_pixels))
    assert large / small == pytest.approx((15 / 11) ** 2, rel=0.3)  # of a few pixels
