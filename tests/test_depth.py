"""Depth and camera geometry against the scene's own shapes: board, stones and cameras are known exactly."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_bomb.bomb.board import BOARD, NUM_STONES
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.expert import expert_action
from lerobot_bomb.bomb.observation import CAMERAS, RenderOptions
from lerobot_bomb.envs.vector import LazyVectorEnv
from lerobot_env_bomb.bomb.env import BombEnv

import mujoco  # isort: skip  (after the env, which chooses an OpenGL backend)

DOCS = Path(__file__).parents[1] / "docs" / "bomb.md"
KINDS = ("depth", "intrinsics", "extrinsics")
KEYS = {f"{kind}.{camera}" for kind in KINDS for camera in CAMERAS}
STONE_AXES_M = np.array([BOARD.stone_radius_m, BOARD.stone_radius_m, BOARD.stone_height_m / 2])

type Observation = dict[str, Any]


def make_env(size: int = 64, depth: bool = True, perturbations: str = "none") -> BombEnv:
    return BombEnv(EpisodeSpec(0, perturbations=perturbations), RenderOptions(image_size=size, depth=depth))


def act(env: BombEnv) -> Observation:
    return env.step(expert_action(env.privileged_state()))[0]


def geometry(observation: Observation, camera: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(H, W) metres, (3, 3), (4, 4), in double precision."""
    depth, intrinsics, extrinsics = (observation[f"{kind}.{camera}"].astype(float) for kind in KINDS)
    return depth, intrinsics, extrinsics


def back_project(observation: Observation, camera: str) -> np.ndarray:
    """(H, W, 3) world points in metres that the pixels show."""
    depth, intrinsics, world_from_camera = geometry(observation, camera)
    rows, columns = np.indices(depth.shape)
    pixels = np.stack([columns, rows, np.ones_like(rows)], axis=-1)
    points = depth[..., None] * (pixels @ np.linalg.inv(intrinsics).T)
    return points @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]


def project(observation: Observation, camera: str, xyz: np.ndarray) -> np.ndarray:
    """(2,) column and row where a world point appears."""
    _, intrinsics, world_from_camera = geometry(observation, camera)
    column, row, scale = intrinsics @ (np.linalg.inv(world_from_camera) @ [*xyz, 1])[:3]
    return np.array([column, row]) / scale


def fit_center(points: np.ndarray) -> np.ndarray:
    """(3,) centre of the stone on whose surface (N, 3) points lie; the stone lies flat at any yaw."""
    center = points.mean(axis=0) - [0, 0, STONE_AXES_M[2]]
    for _ in range(20):
        scaled = (points - center) / STONE_AXES_M
        radius = np.linalg.norm(scaled, axis=1)
        slope = -scaled / STONE_AXES_M / radius[:, None]
        center = center + np.linalg.lstsq(slope, 1 - radius)[0]
    return center


def visible_stones(env: BombEnv, camera: str, labels: np.ndarray, focal_px: float) -> dict[int, np.ndarray]:
    """Index -> (H, W) mask of each stone that is flat and shows at least half of its disc."""
    data, masks = env._run.scene.data, {}
    for stone in range(NUM_STONES):
        geom = env._run.scene.model.geom(f"stone_{stone}_visual").id
        distance_m = np.linalg.norm(data.geom_xpos[geom] - data.camera(camera).xpos)
        disc_px = np.pi * (focal_px * BOARD.stone_radius_m / distance_m) ** 2
        is_flat = data.geom_xmat[geom].reshape(3, 3)[2, 2] > 0.999
        if is_flat and (labels == geom).sum() > disc_px / 2:
            masks[stone] = labels == geom
    return masks


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("size", [64, 256])
def test_depth_shows_board_and_stones_where_they_are(size: int, camera: str) -> None:
    env = make_env(size)
    board_errors, stone_errors, misses_px = [], [], []
    for seed in (1, 4):
        observation, _ = env.reset(seed=seed)
        model = env._run.scene.model
        with mujoco.Renderer(model, size, size) as labeller:
            labeller.enable_segmentation_rendering()
            for _ in range(5):
                labeller.update_scene(env._run.scene.data, camera)
                labels = labeller.render()[..., 0]
                points = back_project(observation, camera)
                board = points[labels == model.geom("board_surface").id]
                board_errors.extend(board[:, 2] - BOARD.thickness_m)
                focal_px = observation[f"intrinsics.{camera}"][0, 0]
                for stone, mask in visible_stones(env, camera, labels, focal_px).items():
                    center = env.privileged_state().stone_xyz[stone]
                    stone_errors.append(np.linalg.norm(fit_center(points[mask]) - center))
                    pixel = project(observation, camera, center)
                    misses_px.append(np.linalg.norm(np.argwhere(mask)[:, ::-1] - pixel, axis=1).min())
                for _ in range(4):
                    observation = act(env)
    env.close()
    assert len(stone_errors) > 10
    assert 1000 * np.abs(board_errors).max() < 0.2
    assert 1000 * np.max(stone_errors) < 1
    assert np.max(misses_px) < 1


def test_the_camera_axes_are_those_that_are_said() -> None:
    """The workspace camera stands before the table, level, and looks down at it."""
    env = make_env()
    observation, _ = env.reset(seed=1)
    env.close()
    _, intrinsics, world_from_camera = geometry(observation, "workspace")
    x, y, z = world_from_camera[:3, :3].T
    np.testing.assert_allclose(x, [1, 0, 0], atol=1e-6)
    assert max(y[1], y[2]) < 0
    assert z[2] < 0 < z[1]
    np.testing.assert_allclose(world_from_camera[:3, 3], [0.046, -0.782, 1.501], rtol=1e-6)
    np.testing.assert_allclose(intrinsics, [[289.852, 0, 31.5], [0, 289.852, 31.5], [0, 0, 1]], rtol=1e-5)


def test_images_do_not_depend_on_depth() -> None:
    plain, deep = make_env(depth=False), make_env()
    pairs = [(plain.reset(seed=3)[0], deep.reset(seed=3)[0])]
    pairs += [(act(plain), act(deep)) for _ in range(3)]
    for without, with_depth in pairs:
        assert list(without) == ["pixels", "agent_pos", "environment_state"]
        assert with_depth.keys() - without.keys() == KEYS
        np.testing.assert_equal({key: with_depth[key] for key in without}, without)
    assert without in plain.observation_space and with_depth in deep.observation_space
    plain.close()
    deep.close()


@pytest.mark.parametrize("use_async", [False, True])
def test_vector_envs_deliver_the_same(use_async: bool) -> None:
    seeds = [5, 6]
    envs = LazyVectorEnv([make_env] * 2, use_async=use_async)
    batches: list[Observation] = [envs.reset(seed=seeds)[0]]
    action = np.array([0.5, 0.5, -0.5, 1], dtype=np.float32)
    batches = [{key: batches[0][key].copy() for key in KEYS}]  # the shared memory is written again
    batches.append(envs.step(np.stack([action, action]))[0])
    one = make_env()
    for row, seed in enumerate(seeds):
        for batch, alone in zip(batches, [one.reset(seed=seed)[0], one.step(action)[0]], strict=True):
            for key in KEYS:
                assert batch[key].dtype == np.float32
                np.testing.assert_array_equal(batch[key][row], alone[key])
    envs.close()
    one.close()


def test_a_camera_that_was_moved_tells_so() -> None:
    nominal, env = make_env(), make_env(perturbations="camera:5")
    first, _ = nominal.reset(seed=7)
    moved, _ = env.reset(seed=7)
    nominal.close()
    later = act(env)
    env.close()
    for kind in KINDS:
        assert not np.allclose(first[f"{kind}.workspace"], moved[f"{kind}.workspace"], rtol=1e-3)
    for observation in (first, moved, later):
        points = back_project(observation, "workspace")
        on_board = (np.abs(points[..., :2]) < 0.1).all(axis=-1) & (points[..., 2] < 0.0055)
        assert on_board.sum() > 100
        assert 1000 * np.abs(points[on_board][:, 2] - BOARD.thickness_m).max() < 0.2


def test_the_example_in_the_documentation_runs() -> None:
    env = make_env()
    observation, _ = env.reset(seed=2)
    env.close()
    (code,) = re.findall(r"```python\n(.*?depth.*?)```", DOCS.read_text(), re.DOTALL)
    found: dict[str, Any] = {"observation": observation}
    exec(code, found)
    np.testing.assert_allclose(found["world_points"], back_project(observation, "workspace"), atol=1e-5)


def test_depth_needs_sharp_edges() -> None:
    with pytest.raises(
        ValueError, match=r"--env\.depth=true needs --env\.render_preset=fast .*, not shadows"
    ):
        RenderOptions(depth=True, preset="shadows")
