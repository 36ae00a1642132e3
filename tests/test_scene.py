import numpy as np
import pytest

from lerobot_bomb.bomb.board import BOARD, NUM_STONES, TRAY_CENTER_XY, TRAY_HALF_SIZE_XY
from lerobot_bomb.bomb.episode import PHYSICS_HZ, ROBOTS, EpisodeSpec
from lerobot_bomb.bomb.layout import Layout
from lerobot_bomb.bomb.observation import CAMERAS, RenderOptions
from lerobot_bomb.bomb.suites.place import STONE
from lerobot_env_bomb.bomb.model import parked_xyz
from lerobot_env_bomb.bomb.perturb import sample_episode
from lerobot_env_bomb.bomb.render import CameraRenderer
from lerobot_env_bomb.bomb.scene import WORKSPACE_HIGH, WORKSPACE_LOW, Scene

NUM_SUBSTEPS = 20
BLACK_AT, WHITE_AT = (1, 1), (3, 3)

REST_HEIGHT_M = BOARD.thickness_m + BOARD.stone_height_m / 2


@pytest.fixture(scope="module", params=ROBOTS)
def scene(request: pytest.FixtureRequest) -> Scene:
    return Scene(request.param)


@pytest.fixture
def layout() -> Layout:
    """A white stone on the tray, a black and a white one on the board."""
    stone_xy = np.zeros((NUM_STONES, 2))
    stone_xy[:3] = [
        TRAY_CENTER_XY,
        BOARD.intersection_xy(*BLACK_AT),
        BOARD.intersection_xy(*WHITE_AT),
    ]
    return Layout(
        gripper_xyz=np.array([*TRAY_CENTER_XY, 0.1]),
        stone_xy=stone_xy,
        stone_is_white=np.arange(NUM_STONES) != 1,
        stone_in_play=np.arange(NUM_STONES) < 3,
    )


def pixel_of(scene: Scene, camera: str, xyz: list[float], size: int) -> tuple[int, int]:
    """(row, column) of a world point in a camera's image."""
    camera_id = scene.model.camera(camera).id
    camera_from_world = scene.data.cam_xmat[camera_id].reshape(3, 3).T
    x, y, z = camera_from_world @ (np.array(xyz) - scene.data.cam_xpos[camera_id])
    focal = size / 2 / np.tan(np.deg2rad(scene.model.cam_fovy[camera_id]) / 2)
    return round(size / 2 + focal * y / z), round(size / 2 - focal * x / z)


def test_every_model_steps_a_second_without_a_warning(scene: Scene) -> None:
    for seed in range(5):
        layout = sample_episode(EpisodeSpec(seed=seed)).layout
        scene.reset(layout)
        before = scene.measure()
        for _ in range(PHYSICS_HZ // NUM_SUBSTEPS):
            scene.move(layout.gripper_xyz, True, NUM_SUBSTEPS)
        after = scene.measure()
        assert not any(warning.number for warning in scene.data.warning)
        np.testing.assert_allclose(after.stone_xyz, before.stone_xyz, atol=1e-4)
        np.testing.assert_allclose(after.gripper_xyz, layout.gripper_xyz, atol=1e-5)


def test_the_model_runs_at_the_schemas_physics_rate(scene: Scene) -> None:
    assert scene.model.opt.timestep * PHYSICS_HZ == pytest.approx(1)


@pytest.mark.parametrize(
    "xyz", [(-0.13, -0.13, 0.006), (0.21, 0.13, 0.16), (0.0, 0.0, 0.05), (0.21, -0.13, 0.1)]
)
def test_the_arm_reaches_all_of_the_workspace(scene: Scene, layout: Layout, xyz: tuple) -> None:
    scene.reset(Layout(np.array(xyz), layout.stone_xy, layout.stone_is_white, layout.stone_in_play))
    np.testing.assert_allclose(scene.measure().gripper_xyz, xyz, atol=1e-9)


def test_commands_are_clipped_to_the_workspace(scene: Scene, layout: Layout) -> None:
    scene.reset(layout)
    for _ in range(3):
        scene.move(np.array([1.0, 1.0, 1.0]), True, NUM_SUBSTEPS)
    np.testing.assert_allclose(scene.measure().gripper_xyz, WORKSPACE_HIGH, atol=1e-3)
    for _ in range(3):
        scene.move(np.array([-1.0, -1.0, -1.0]), True, NUM_SUBSTEPS)
    np.testing.assert_allclose(scene.measure().gripper_xyz, WORKSPACE_LOW, atol=1e-3)


def test_fingers_open_and_close_within_a_control_step(scene: Scene, layout: Layout) -> None:
    scene.reset(layout)
    assert scene.measure().finger_opening == pytest.approx(2 * scene.robot.max_half_opening_m)
    scene.move(layout.gripper_xyz, False, NUM_SUBSTEPS)
    assert scene.measure().finger_opening < 0.004
    scene.move(layout.gripper_xyz, True, NUM_SUBSTEPS)
    assert scene.measure().finger_opening > 2 * scene.robot.max_half_opening_m - 0.004


def test_open_fingers_clear_the_neighbours_of_the_stone_between_them(scene: Scene, layout: Layout) -> None:
    scene.reset(layout)
    for side, sign in (("left", -1), ("right", 1)):
        pad, placed = scene.model.geom(f"{side}_pad"), scene.data.geom(f"{side}_pad")
        center_m = sign * (placed.xpos - layout.gripper_xyz)[0]
        half_thickness_m = (abs(placed.xmat.reshape(3, 3)) @ pad.size)[0]
        assert center_m - half_thickness_m == pytest.approx(scene.robot.max_half_opening_m)
        assert center_m + half_thickness_m + 0.001 < BOARD.pitch_m - BOARD.stone_radius_m
    assert BOARD.stone_radius_m + 0.003 < scene.robot.max_half_opening_m


def test_stones_out_of_play_are_parked_unseen_and_weightless(scene: Scene, layout: Layout) -> None:
    scene.reset(layout)
    scene.move(layout.gripper_xyz, True, 200)
    for i in range(3, NUM_STONES):
        np.testing.assert_allclose(scene.measure().stone_xyz[i], parked_xyz(i), atol=1e-9)
        assert scene.model.geom(f"stone_{i}_visual").rgba[3] == 0


@pytest.mark.parametrize("tilt", [0.0, 0.01, 0.1])
@pytest.mark.parametrize("depth_m", [0.0, 0.001, 0.004])
def test_a_stone_pressed_into_the_board_comes_out_flat(
    scene: Scene, layout: Layout, tilt: float, depth_m: float
) -> None:
    scene.reset(layout)
    x, y = BOARD.intersection_xy(0, 0)
    scene.data.joint("stone_0").qpos = [x, y, REST_HEIGHT_M - depth_m, 1, tilt, 0, 0]
    scene.move(layout.gripper_xyz, True, 200)
    assert scene.measure().stone_xyz[STONE, 2] == pytest.approx(REST_HEIGHT_M, abs=1e-4)


def test_both_pads_touch_a_held_stone(scene: Scene, layout: Layout) -> None:
    scene.reset(layout)
    assert not scene.measure().stone_touched.any()
    grasp = np.array([*TRAY_CENTER_XY, 0.007])
    for _ in range(3):
        scene.move(grasp, True, NUM_SUBSTEPS)
    scene.move(grasp, False, NUM_SUBSTEPS)
    assert scene.measure().stone_touched[STONE].all()
    assert not scene.measure().stone_touched[1:].any()
    for _ in range(2):
        scene.move(grasp + np.array([0, 0, 0.05]), False, NUM_SUBSTEPS)
    assert scene.measure().stone_xyz[STONE, 2] > REST_HEIGHT_M + 0.04


@pytest.fixture(scope="module")
def renderer(scene: Scene):
    renderer = CameraRenderer(scene.model, RenderOptions(image_size=256), max_size=256)
    yield renderer
    renderer.close()


@pytest.mark.parametrize("size", [64, 256])
def test_the_workspace_camera_sees_board_tray_stones_and_gripper(
    scene: Scene, layout: Layout, renderer: CameraRenderer, size: int
) -> None:
    scene.reset(layout)
    image = renderer.draw(scene.data, "workspace", size)
    assert image.shape == (size, size, 3) and image.dtype == np.uint8
    edge = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
    corners = [*(BOARD.half_size_m * edge), *(np.array(TRAY_CENTER_XY) + np.array(TRAY_HALF_SIZE_XY) * edge)]
    points = [[*corner, BOARD.thickness_m] for corner in corners] + [list(layout.gripper_xyz)]
    for point in points:
        assert all(0 <= p < size for p in pixel_of(scene, "workspace", point, size)), point
    black = image[pixel_of(scene, "workspace", [*layout.stone_xy[1], BOARD.thickness_m + 0.009], size)]
    white = image[pixel_of(scene, "workspace", [*layout.stone_xy[2], BOARD.thickness_m + 0.009], size)]
    assert black.max() < 80 and white.min() > 170
    red, green, blue = (int(c) for c in image[pixel_of(scene, "workspace", [0.11, -0.11, 0.005], size)])
    assert red > green > blue  # wood


def test_the_wrist_camera_sees_the_stone_at_the_start(
    scene: Scene, layout: Layout, renderer: CameraRenderer
) -> None:
    for angle_rad in np.linspace(0, 2 * np.pi, 8):
        offset = 0.015 * np.array([np.cos(angle_rad), np.sin(angle_rad)])
        stone_xy = layout.stone_xy.copy()
        stone_xy[STONE] += offset
        scene.reset(Layout(layout.gripper_xyz, stone_xy, layout.stone_is_white, layout.stone_in_play))
        image = renderer.draw(scene.data, "wrist", 256)
        assert image[pixel_of(scene, "wrist", [*stone_xy[STONE], 0.014], 256)].min() > 170


def test_images_of_the_same_state_are_the_same(
    scene: Scene, layout: Layout, renderer: CameraRenderer
) -> None:
    scene.reset(layout)
    first = [renderer.draw(scene.data, camera, 128) for camera in CAMERAS]
    renderer.draw(scene.data, "wrist", 256)
    for camera, image in zip(CAMERAS, first, strict=True):
        np.testing.assert_array_equal(renderer.draw(scene.data, camera, 128), image)


def test_shadows_darken_the_board() -> None:
    layout = sample_episode(EpisodeSpec(seed=0)).layout
    images = []
    for preset in ("fast", "shadows"):
        scene = Scene()
        scene.reset(layout)
        renderer = CameraRenderer(scene.model, RenderOptions(preset=preset), max_size=256)
        images.append(renderer.draw(scene.data, "workspace", 256).astype(int))
        renderer.close()
    assert ((images[0] - images[1]).sum(axis=-1) > 60).mean() > 0.005
