"""`bomb_libero` in its simulator: level 0 is LeRobot's `libero`, and each axis changes only what it names.

Needs hf-libero and its assets of one suite; skips without. One environment runs every condition, since
building one takes seconds.
"""

import copy
import importlib
import pickle
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium.error import ResetNeeded

from lerobot_bomb.conditions import MAX_LEVEL, NONE
from lerobot_bomb.libero.assets import Libero, prepare_libero
from lerobot_bomb.libero.episode import LiberoSpec
from lerobot_bomb.libero.perturbations import LIBERO_AXES, libero_magnitude
from lerobot_bomb.results.libero import LiberoResult
from lerobot_bomb.results.reading import read_records

SUITE = "libero_spatial"
IMAGE_SIZE = 48
CAMERAS = ("image", "image2")
# of mjModel, what an axis may change
FIELDS = {
    "table": {"tex_data"},
    "reflectance": {"tex_data", "mat_specular", "mat_shininess"},
    "distractors": {"body_pos", "geom_rgba", "geom_contype", "geom_conaffinity"},
    "camera": {"cam_pos", "cam_quat", "cam_fovy"},
    "light": {"light_dir", "light_diffuse", "light_specular", "headlight"},
    "dynamics": {
        "body_mass",
        "body_inertia",
        "body_subtreemass",
        "body_invweight0",
        "dof_invweight0",
        "geom_friction",
    },
    "object": {"mat_rgba", "geom_rgba"},
}
COMPARED = (
    "body_pos", "body_quat", "body_mass", "body_inertia", "body_subtreemass", "body_invweight0",
    "dof_invweight0", "geom_pos", "geom_quat", "geom_size", "geom_rgba",
    "geom_friction", "geom_contype", "geom_conaffinity", "geom_matid", "mat_rgba", "mat_specular",
    "mat_shininess", "mat_reflectance", "mat_emission", "mat_texid", "cam_pos", "cam_quat", "cam_fovy",
    "light_pos", "light_dir", "light_diffuse", "light_specular", "light_ambient", "dof_damping",
    "actuator_gainprm", "jnt_range", "tex_data",
)  # fmt: skip
ACTIONS = np.array([[0.5, -0.3, -0.6, 0.1, 0, 0.2, -1], [0.2, 0.4, -0.9, 0, 0.1, 0, -1]] * 3, np.float32)


def make(condition: str, task_id: int = 0, render_preset: str = "stock", **kwargs: Any) -> Any:
    module = importlib.import_module("lerobot_env_bomb.libero.env")
    max_steps = kwargs.pop("max_steps", None)
    size = {"observation_height": IMAGE_SIZE, "observation_width": IMAGE_SIZE}
    scene = size | {"obs_type": "pixels_agent_pos", "render_preset": render_preset}
    return module.BombLiberoEnv(LiberoSpec(0, SUITE, task_id, max_steps, condition), scene, **kwargs)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("results") / "lines.jsonl"


@pytest.fixture(scope="module")
def env(libero_with_assets: Libero, results: Path) -> Iterator[Any]:
    prepare_libero([SUITE])
    # what any axis adds to the model is there
    made = make("all:1", max_steps=len(ACTIONS), results_path=str(results))
    yield made
    made.close()


def begin(env: Any, condition: str, seed: int) -> tuple[dict[str, Any], str]:
    """The first observation and the instruction of an episode under a condition."""
    env._spec = replace(env._spec, perturbations=condition)
    observation, _ = env.reset(seed=seed)
    return observation, env.task_description


def flat(state: dict[str, Any]) -> np.ndarray:
    return np.concatenate([np.ravel(value) for part in state.values() for value in part.values()])


def fields_of(env: Any) -> dict[str, np.ndarray]:
    model = env._scene.model
    headlight = model.vis.headlight
    light = np.concatenate([headlight.ambient, headlight.diffuse, headlight.specular])
    return {name: getattr(model, name).copy() for name in COMPARED} | {"headlight": light}


def make_current(stock: Any) -> None:
    """Make the context current: robosuite draws, and frees, in whichever OpenGL context is."""
    stock._env.sim._render_context_offscreen.gl_ctx.make_current()


@pytest.mark.long
def test_level_0_is_lerobots_environment_bit_for_bit(env: Any) -> None:
    from lerobot.envs.factory import make_env, make_env_config

    size = {"observation_height": IMAGE_SIZE, "observation_width": IMAGE_SIZE}
    config = make_env_config("libero", task=SUITE, task_ids=[0], **size)
    vector: Any = make_env(config, n_envs=1)[SUITE][0]
    stock = vector.envs[0].unwrapped
    begin(env, "all:5", 7)  # of which nothing must be left
    stock.init_state_id = 3
    observation, text = begin(env, NONE, 53)
    moments = [(stock.reset(seed=53)[0], observation)]
    for action in ACTIONS:
        make_current(stock)
        theirs, ours = stock.step(action), env.step(action)
        assert theirs[1:3] == ours[1:3]
        moments.append((theirs[0], ours[0]))
    assert text == stock.task_description
    for theirs, ours in moments:
        np.testing.assert_array_equal(flat(theirs["robot_state"]), flat(ours["robot_state"]))
        for name in CAMERAS:
            np.testing.assert_array_equal(theirs["pixels"][name], ours["pixels"][name])
    np.testing.assert_array_equal(stock.render(), env.render())
    make_current(stock)
    stock.close()


@pytest.mark.parametrize("axis", LIBERO_AXES)
def test_an_axis_changes_what_it_names_and_nothing_else(env: Any, axis: str) -> None:
    changes = LIBERO_AXES[axis].changes
    (nominal, text), before = begin(env, NONE, 11), fields_of(env)
    (perturbed, other_text), after = begin(env, f"{axis}:3", 11), fields_of(env)
    changed = {name for name in before if not np.array_equal(before[name], after[name])}
    assert changed == FIELDS.get(axis, set())
    assert (text != other_text) == ("instruction" in changes)
    are_same = all(np.array_equal(nominal["pixels"][name], perturbed["pixels"][name]) for name in CAMERAS)
    assert are_same == ("images" not in changes)
    is_same_state = np.allclose(flat(nominal["robot_state"]), flat(perturbed["robot_state"]), atol=1e-12)
    assert is_same_state == ("scene" not in changes)


def test_nothing_is_left_of_an_episode_in_the_next(env: Any) -> None:
    first, before = begin(env, NONE, 4)[0], fields_of(env)
    begin(env, "all:5", 5)
    for action in ACTIONS:
        env.step(action)
    again, after = begin(env, NONE, 4)[0], fields_of(env)
    assert all(np.array_equal(before[name], after[name]) for name in before)
    np.testing.assert_array_equal(first["pixels"]["image"], again["pixels"]["image"])
    np.testing.assert_array_equal(flat(first["robot_state"]), flat(again["robot_state"]))


@pytest.mark.long
def test_two_environments_of_a_process_draw_each_its_own(env: Any) -> None:
    nominal = begin(env, NONE, 4)[0]["pixels"]["image"]
    other = make(NONE)
    np.testing.assert_array_equal(begin(other, NONE, 4)[0]["pixels"]["image"], nominal)
    perturbed = begin(env, "table:5", 4)[0]["pixels"]["image"]
    assert not np.array_equal(perturbed, nominal)
    np.testing.assert_array_equal(begin(other, NONE, 4)[0]["pixels"]["image"], nominal)
    other.close()
    np.testing.assert_array_equal(begin(env, "table:5", 4)[0]["pixels"]["image"], perturbed)


@pytest.mark.parametrize("seed", range(3))
def test_objects_start_elsewhere_apart_from_each_other_and_on_the_table(env: Any, seed: int) -> None:
    def places(condition: str) -> dict[str, np.ndarray]:
        begin(env, condition, seed)
        return {name: env._scene.data.xpos[body].copy() for name, body in env._scene.movable.items()}

    nominal, moved = places(NONE), places("start:5")
    shifts_m = {name: float(np.linalg.norm(moved[name] - nominal[name])) for name in nominal}
    limit_m = libero_magnitude("start", "objects", 5) / 1000
    assert max(shifts_m.values()) > 0.9 * limit_m
    assert all(shift_m < limit_m + 0.004 for shift_m in shifts_m.values())  # what settles
    assert all(abs(moved[name][2] - nominal[name][2]) < 0.004 for name in nominal)


@pytest.mark.parametrize("seed", range(3))
def test_what_was_in_view_of_the_scenes_camera_stays_there(env: Any, seed: int) -> None:
    from lerobot_env_bomb.libero.axes.camera import _is_in_view
    from lerobot_env_bomb.shared.rotations import matrix_of

    def shown(condition: str) -> np.ndarray:
        begin(env, condition, seed)
        scene = env._scene
        camera = scene.model.camera("agentview").id
        offsets = scene.corners() - scene.model.cam_pos[camera]
        return _is_in_view(offsets, matrix_of(scene.model.cam_quat[camera]), scene.model.cam_fovy[camera])

    nominal = shown(NONE)
    assert nominal.mean() > 0.8
    for level in (3, 5):
        assert shown(f"camera:{level}")[nominal].all()


def test_a_distractor_more_at_each_level_where_the_others_were(env: Any) -> None:
    counts, places = [], []
    for level in range(1, MAX_LEVEL + 1):
        begin(env, f"distractors:{level}", 2)
        model = env._scene.model
        bodies = [model.body(f"distractor{number}").id for number in range(MAX_LEVEL)]
        seen = [body for body in bodies if (model.geom_rgba[model.geom_bodyid == body, 3] == 1).any()]
        counts.append(len(seen))
        places.append(model.body_pos[seen].copy())
        boxes = env._scene.boxes()
        for body in seen:
            low, high = model.body_pos[body] - 0.022, model.body_pos[body] + 0.022
            assert not any((low < box[1]).all() and (high > box[0]).all() for box in boxes.values())
    assert counts == [1, 2, 3, 4, 5]
    assert all(np.array_equal(below, above[: len(below)]) for below, above in pairwise(places))


def test_dynamics_delay_actions_and_make_objects_heavier_or_lighter(env: Any) -> None:
    def path(condition: str) -> np.ndarray:
        begin(env, condition, 6)
        return np.array([env.step(action)[0]["robot_state"]["eef"]["pos"] for action in ACTIONS])

    nominal, late = path(NONE), path("dynamics:5")
    assert np.linalg.norm(late - nominal, axis=1).max() > 0.002
    masses = {}
    for condition in (NONE, "dynamics:5"):
        begin(env, condition, 6)
        masses[condition] = env._scene.model.body_mass[list(env._scene.movable.values())].copy()
    factor = masses["dynamics:5"] / masses[NONE]
    assert np.allclose(factor, 2.5) or np.allclose(factor, 1 / 2.5)


def test_without_drawing_states_are_the_same_and_films_are_drawn(
    env: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run() -> tuple[dict[str, Any], np.ndarray]:
        begin(env, "light:2", 3)
        observation, *_ = env.step(ACTIONS[0])
        return observation, env.render()

    (shown, film), _ = run(), monkeypatch.setattr(env._scene, "_draws", False)
    black, same_film = run()
    assert not any(image.any() for image in black["pixels"].values())
    np.testing.assert_array_equal(flat(shown["robot_state"]), flat(black["robot_state"]))
    assert film.any()
    assert (film != same_film).mean() < 0.05  # a simulator step apart


def test_a_region_of_the_table_is_no_object(libero: Libero) -> None:
    from lerobot_env_bomb.libero.scene import LiberoScene

    sites = {"main_table_stove_front_region": SimpleNamespace(parent_name=None)}
    env = SimpleNamespace(object_sites_dict=sites, obj_of_interest=["plate_1", *sites])
    scene: Any = SimpleNamespace(_built=SimpleNamespace(env=env))
    wanted: Any = LiberoScene.wanted
    assert wanted.func(scene) == {"plate_1"}


def test_what_the_gripper_touches_is_told_by_name(env: Any) -> None:
    begin(env, NONE, 6)
    scene = env._scene
    assert scene.touched() == set() and scene.wanted == {"akita_black_bowl_1", "plate_1"}
    body = scene.movable["plate_1"]
    address = scene.model.jnt_qposadr[scene.model.body_jntadr[body]]
    scene.data.qpos[address : address + 3] = scene.gripper_xyz()
    importlib.import_module("mujoco").mj_forward(scene.model, scene.data)
    assert scene.touched() == {"plate_1"}


def test_an_episode_ends_after_its_steps_with_a_line_of_results(env: Any, results: Path) -> None:
    begin(env, "light:2", 1001)
    assert env._max_episode_steps == len(ACTIONS)
    for action in ACTIONS[:-1]:
        *_, info = env.step(action)
        assert info["failure"] == ""
    results.unlink(missing_ok=True)  # of other tests' episodes
    _, reward, terminated, truncated, info = env.step(ACTIONS[-1])
    assert (reward, terminated, truncated, info["failure"]) == (0, False, True, "never_touched")
    again = env.step(ACTIONS[0])
    assert again[1:4] == (0, False, True) and env.episode_result().steps == len(ACTIONS)
    records, damages = read_records(results)
    (record,) = records.values()
    assert damages == []
    assert isinstance(record, LiberoResult)
    assert record.spec.seed == 1001 and record.initial_state == 1 and record.levels == {"light": 2}


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros(6), r"action has shape \(6,\), expected \(7,\)"),
        (np.full(7, np.nan), "is not finite"),
        (np.full(7, 1e308), "is not finite in float32"),
        (np.full(7, 1j), "holds complex128, not numbers"),  # the gripper's controller would keep it
        (np.array(["0"] * 7), "holds <U1, not numbers"),
    ],
)
def test_an_action_that_is_none_is_refused(env: Any, action: np.ndarray, message: str) -> None:
    if env._current_run is None:
        begin(env, NONE, 0)
    with pytest.raises(ValueError, match=message):
        env.step(action)


@pytest.mark.long
def test_closing_ends_the_episode_and_a_reset_starts_the_same_anew(libero_with_assets: Libero) -> None:
    prepare_libero([SUITE])
    env = make(NONE)
    copied = pickle.loads(pickle.dumps(env))
    copied.close()
    first, _ = env.reset(seed=np.int64(7))
    with pytest.raises(TypeError, match="a BombLiberoEnv that has been reset cannot be pickled or copied"):
        copy.deepcopy(env)
    env.step(ACTIONS[0].astype(bool))  # whole numbers do, as they do elsewhere
    env.close()
    env.close()
    for use in (lambda: env.step(ACTIONS[0]), env.render):
        with pytest.raises(ResetNeeded):
            use()
    again, info = env.reset(seed=7)
    assert info["seed"] == 7
    np.testing.assert_array_equal(first["pixels"]["image"], again["pixels"]["image"])
    assert env.reset()[1]["seed"] == 2029167941  # Gymnasium's generator draws it
    env.close()


@pytest.mark.long
@pytest.mark.parametrize("axis", [name for name, axis in LIBERO_AXES.items() if "images" in axis.changes])
def test_each_level_changes_images_more_than_the_one_below(env: Any, axis: str) -> None:
    images = [
        np.stack([begin(env, f"{axis}:{level}", seed)[0]["pixels"]["image"] for seed in range(8)]).astype(
            float
        )
        for level in range(MAX_LEVEL + 1)
    ]
    sizes = [float(np.abs(each - images[0]).mean()) for each in images]
    assert all(above > 1.03 * below for below, above in pairwise(sizes)), sizes


@pytest.mark.long
@pytest.mark.parametrize("task_id", range(10))
def test_every_task_can_be_perturbed(libero_with_assets: Libero, task_id: int) -> None:
    made = make("all:5", task_id)
    for seed in range(3):
        observation, text = begin(made, "all:5", seed)
        model = made._scene.model
        bodies = [model.body(f"distractor{number}").id for number in range(MAX_LEVEL)]
        assert all((model.geom_rgba[model.geom_bodyid == body, 3] == 1).any() for body in bodies)
        assert "black bowl" in text and observation["pixels"]["image"].std() > 5
    made.close()


@pytest.mark.long
def test_sync_and_async_workers_see_the_same_bits(libero_with_assets: Libero) -> None:
    from lerobot_env_bomb.libero.configuration_bomb_libero import BombLiberoEnvConfig

    config = BombLiberoEnvConfig(
        task_ids=[0], perturbations=["all:3"], observation_height=IMAGE_SIZE, observation_width=IMAGE_SIZE
    )
    seen = []
    for use_async in (False, True):
        vector = config.create_envs(2, use_async)[f"{SUITE}.all-3"][0]
        first, _ = vector.reset(seed=[1000, 1001])
        last, *_ = vector.step(np.stack([ACTIONS[0], ACTIONS[1]]))
        seen.append([*first["pixels"].values(), *last["pixels"].values(), first["robot_state"]["eef"]["pos"]])
        vector.close()
    for one, other in zip(*seen, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.long
def test_the_fast_preset_draws_the_same_scene_and_says_so(libero_with_assets: Libero) -> None:
    """Compare with the stock images, and with the fast ones of which nothing out of view is left out."""
    made = {preset: make(NONE, render_preset=preset, max_steps=1) for preset in ("stock", "fast")}
    images = {preset: env.reset(seed=3)[0]["pixels"] for preset, env in made.items()}
    for camera in CAMERAS:
        stock, fast = (images[preset][camera].astype(float) for preset in ("stock", "fast"))
        assert (stock != fast).any()
        assert abs(stock - fast).mean() < 6  # grey levels
    fast = made["fast"]
    scene = fast._scene
    cameras = [scene.model.camera(name).id for name in ("agentview", "robot0_eye_in_hand")]
    hidden = [scene._is_out_of_view(camera) for camera in cameras]
    assert all(0 < each.sum() < len(each) for each in hidden)
    group = scene.model.geom_group.copy()
    scene._is_out_of_view = lambda camera: np.zeros(scene.model.ngeom, bool)
    whole = fast.reset(seed=3)[0]["pixels"]
    for camera in CAMERAS:
        np.testing.assert_array_equal(whole[camera], images["fast"][camera])
    np.testing.assert_array_equal(scene.model.geom_group, group)
    fast.step(ACTIONS[0])
    result = fast.episode_result()
    assert result.render_preset == "fast"
    assert "--env.render_preset=fast" in LiberoResult.eval_flags([result])
    for env in made.values():
        env.close()
