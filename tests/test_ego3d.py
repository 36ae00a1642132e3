"""Ego3D position encoding: SpatialVLA's numbers, and BOMB's stones through crop and resize."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from lerobot_bomb.bomb.board import BOARD, NUM_STONES
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.expert import expert_action
from lerobot_bomb.bomb.observation import CAMERAS, RenderOptions
from lerobot_bomb.vlm.depth import lattice_points, observed_depth, observed_intrinsics
from lerobot_bomb.vlm.ego3d import Ego3D, encode_points
from lerobot_bomb.vlm.images import CropWindows, draw_windows
from lerobot_bomb.vlm.intrinsics import crop_intrinsics
from lerobot_env_bomb.bomb.env import BombEnv

import mujoco  # isort: skip  (after the env, which chooses an OpenGL backend)

STONE_AXES_M = np.array([BOARD.stone_radius_m, BOARD.stone_radius_m, BOARD.stone_height_m / 2])
NAN = torch.nan


def camera(focal_x: float, focal_y: float, center_x: float, center_y: float) -> Tensor:
    return torch.tensor([[[focal_x, 0, center_x], [0, focal_y, center_y], [0, 0, 1.0]]])


def random_points(batch_size: int, size: int) -> Tensor:
    return torch.randn(batch_size, size, size, 3, generator=torch.Generator().manual_seed(0)).abs() + 0.1


# Encoding


def test_a_point_is_encoded_as_published() -> None:
    encoded = encode_points(torch.tensor([0.5, -0.25, 1]), 2).unflatten(0, (3, 5))
    sines = [[0.247404, 0.479426], [-0.124675, -0.247404], [-0.479426, -0.841471]]
    cosines = [[0.968912, 0.877583], [0.992198, 0.968912], [0.877583, 0.540302]]
    expected = [[x, *sin, *cos] for x, sin, cos in zip([0.25, -0.125, -0.5], sines, cosines, strict=True)]
    assert torch.allclose(encoded, torch.tensor(expected), atol=1e-6)


def test_a_patch_reads_its_points_line_by_line() -> None:
    ego3d = Ego3D(hidden_size=4, patches_per_side=2, num_freqs=0)
    ego3d.layers = nn.Sequential()
    rows, columns = torch.meshgrid(torch.arange(4), torch.arange(4), indexing="ij")
    points = torch.stack([rows, columns, torch.ones(4, 4)], dim=-1)[None].float()
    patches = (ego3d(points) * 2 + torch.tensor([0.0, 0, 2] * 4)).unflatten(2, (4, 3))[0, ..., :2]
    assert patches[0].tolist() == [[0, 0], [0, 1], [1, 0], [1, 1]]
    assert patches[1].tolist() == [[0, 2], [0, 3], [1, 2], [1, 3]]
    assert patches[2].tolist() == [[2, 0], [2, 1], [3, 0], [3, 1]]


def test_without_a_vector_for_it_a_patch_that_lacks_depth_gets_nothing() -> None:
    with_vector, without = (
        Ego3D(hidden_size=5, patches_per_side=2, zero_init=False, no_depth_vector=has)
        for has in (True, False)
    )
    without.load_state_dict({name: t for name, t in with_vector.state_dict().items() if name != "no_depth"})
    points = random_points(2, 4)
    expected = with_vector(points)
    assert torch.equal(without(points), expected)
    points[0, 1, 2] = NAN  # of the second patch
    assert not without(points)[0, 1].any() and with_vector(points)[0, 1].any()
    kept = torch.tensor([[True, False, True, True], [True] * 4])
    assert torch.equal(without(points)[kept], expected[kept])


def test_the_published_size_of_a_patch() -> None:
    ego3d = Ego3D(hidden_size=5, patches_per_side=16)
    assert ego3d.lattice_size == 32
    assert ego3d.layers[0].weight.shape == (5, 204)


def test_nothing_is_added_before_training_and_something_after_a_step() -> None:
    ego3d = Ego3D(hidden_size=6, patches_per_side=3)
    points = random_points(2, 6)
    points[0, :2, :3] = NAN
    assert ego3d(points).eq(0).all()
    optimizer = torch.optim.SGD(ego3d.parameters(), lr=0.1)
    for _ in range(2):
        optimizer.zero_grad()
        (ego3d(points) - 1).square().mean().backward()
        optimizer.step()
    assert ego3d(points).ne(0).all()
    assert ego3d.no_depth.ne(0).all()
    assert torch.isfinite(torch.cat([parameter.flatten() for parameter in ego3d.parameters()])).all()


def test_the_published_initialisation_is_small() -> None:
    added = Ego3D(hidden_size=64, patches_per_side=3, zero_init=False)(random_points(2, 6))
    assert 0 < added.std(dim=1).max() < 0.05


@pytest.mark.parametrize("no_depth", [NAN, torch.inf, -torch.inf, 0.0, -1.0])
def test_a_learned_vector_stands_for_points_without_depth(no_depth: float) -> None:
    ego3d = Ego3D(hidden_size=4, patches_per_side=2, num_freqs=0)
    ego3d.layers = nn.Sequential()
    ego3d.no_depth.data = torch.tensor([7.0, 8, 9])
    depth = torch.ones(2, 4, 4)
    depth[0, 1, 2] = no_depth
    patches = ego3d(lattice_points(depth, camera(5, 5, 2, 2), 4)).unflatten(2, (4, 3))
    assert patches[0, 1, 2].tolist() == [7, 8, 9]
    patches[0, 1, 2] = patches[1, 1, 2]
    assert patches[0].equal(patches[1])


def test_depth_out_of_range_is_moved_along_its_ray() -> None:
    ego3d = Ego3D(hidden_size=4, patches_per_side=2, num_freqs=0)
    ego3d.layers = nn.Sequential()
    K = camera(5, 5, 2, 2)
    far, farther, near, nearer = (
        ego3d(lattice_points(torch.full((1, 4, 4), depth_m), K, 4)) for depth_m in (10, 90, 0.01, 0.001)
    )
    assert torch.allclose(far, farther) and torch.allclose(near, nearer)
    assert not torch.allclose(far, near)


def test_a_result_does_not_depend_on_the_batch() -> None:
    ego3d = Ego3D(hidden_size=16, patches_per_side=3, zero_init=False)
    points = random_points(3, 6)
    points[1] = NAN
    together = ego3d(points)
    for row in range(3):
        assert torch.allclose(ego3d(points[row : row + 1])[0], together[row], atol=1e-6)


def test_the_encoding_is_exact_under_autocast_and_in_a_bfloat16_model() -> None:
    """bfloat16 tells 1.500 m from 1.508 m at best."""
    depth = torch.tensor([1.5, 1.502]).view(2, 1, 1)
    ego3d = Ego3D(hidden_size=4, patches_per_side=1, patch_reso=1).bfloat16()
    seen = []
    ego3d.layers.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0][:, 0].float()))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        ego3d(lattice_points(depth, camera(100, 100, 0.3, 0.3), 1))
    angles = np.outer([1.5 / 2 - 1, 1.502 / 2 - 1], 2.0 ** np.arange(8))  # of the third coordinate
    expected = np.concatenate([angles[:, :1], np.sin(angles), np.cos(angles)], axis=1)
    np.testing.assert_allclose(seen[0][:, -17:].detach().numpy(), expected, rtol=0, atol=0.004)


# BOMB


def stone_labels(env: BombEnv, name: str, size: int) -> np.ndarray:
    """(size, size) index of the flat stone that each pixel shows, or -1."""
    model, data = env._run.scene.model, env._run.scene.data
    with mujoco.Renderer(model, size, size) as labeller:
        labeller.enable_segmentation_rendering()
        labeller.update_scene(data, name)
        geoms = labeller.render()[..., 0]
    labels = np.full((size, size), -1)
    for stone in range(NUM_STONES):
        geom = model.geom(f"stone_{stone}_visual").id
        if data.geom_xmat[geom][-1] > 0.999:
            labels[geoms == geom] = stone
    return labels


def surface_distance(points: np.ndarray, center: np.ndarray) -> np.ndarray:
    """(N,) metres from (N, 3) points to a flat stone's surface, to first order."""
    scaled = (points - center) / STONE_AXES_M
    radius = np.linalg.norm(scaled, axis=1)
    return np.abs(radius - 1) * radius / np.linalg.norm(scaled / STONE_AXES_M, axis=1)


def frames(size: int, name: str) -> Iterator[tuple[dict[str, Any], np.ndarray, np.ndarray]]:
    """Observation, stones' centres and labels of the first steps of some episodes."""
    env = BombEnv(EpisodeSpec(0), RenderOptions(image_size=size, depth=True))
    for seed in (1, 2, 3, 5):
        observation, _ = env.reset(seed=seed)
        for _ in range(2):
            yield observation, env.privileged_state().stone_xyz, stone_labels(env, name, size)
            for _ in range(4):
                observation = env.step(expert_action(env.privileged_state()))[0]
    env.close()


def world_points(
    observation: dict[str, Any], name: str, size: int, seed: int
) -> tuple[np.ndarray, CropWindows]:
    """Return world points as a policy gets them: (size, size, 3) of a random crop, and its window."""
    batch = {
        f"observation.{kind}.{name}": torch.from_numpy(observation[f"{kind}.{name}"])[None]
        for kind in ("depth", "intrinsics")
    }
    pose = observation[f"extrinsics.{name}"].astype(float)
    depth = observed_depth(batch, name, observation[f"depth.{name}"].shape)
    windows = draw_windows(depth, 0.9, torch.Generator().manual_seed(seed))
    K = crop_intrinsics(observed_intrinsics(batch, name, {}), windows)
    points = lattice_points(windows.cut(depth), K, size)[0].double().numpy()
    return points @ pose[:3, :3].T + pose[:3, 3], windows


@pytest.mark.parametrize("name", CAMERAS)
def test_stone_centres_are_found_at_their_pixels(name: str) -> None:
    """Check that a point is a stone's top, within 2 mm, where a cropped and resized image shows it."""
    errors_mm = []
    top_m = np.array([0, 0, BOARD.stone_height_m / 2])
    for seed, (observation, stone_xyz, labels) in enumerate(frames(256, name)):
        world, windows = world_points(observation, name, 224, seed)
        camera_from_world = np.linalg.inv(observation[f"extrinsics.{name}"].astype(float))
        for stone, center in enumerate(stone_xyz):
            column, row, scale = (
                observation[f"intrinsics.{name}"] @ (camera_from_world @ [*(center + top_m), 1])[:3]
            )
            pixel = np.array([row, column]) / scale
            cell = np.floor((pixel + 0.5 - windows.offsets[0].numpy()) * 224 / windows.height).astype(int)
            if (
                scale > 0
                and ((cell >= 0) & (cell < 224)).all()
                and labels[tuple(pixel.round().astype(int))] == stone
            ):
                errors_mm.append(1000 * (world[tuple(cell)] - top_m - center))
    assert len(errors_mm) >= 8
    assert np.linalg.norm(errors_mm, axis=1).max() < 2
    assert np.linalg.norm(np.mean(errors_mm, axis=0)) < 0.3  # half a pixel shows


@pytest.mark.parametrize("name", CAMERAS)
def test_a_policys_points_lie_on_the_stones_that_they_show(name: str) -> None:
    """Check all points of 16x16 patches that fall on a stone."""
    errors_mm = []
    for seed, (observation, stone_xyz, labels) in enumerate(frames(256, name)):
        world, windows = world_points(observation, name, 32, seed)
        lines = ((np.arange(32) + 0.5) * windows.height / 32).astype(int)
        shown = windows.cut(torch.from_numpy(labels)[None])[0].numpy()[lines[:, None], lines]
        for stone in set(shown[shown >= 0]):
            errors_mm.extend(1000 * surface_distance(world[shown == stone], stone_xyz[stone]))
    assert len(errors_mm) > 40
    assert np.max(errors_mm) < 2
