"""SAPIEN's renderer shows MuJoCo's scene: the same shapes where they are, as bright, as the axes edit it."""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sapien import render

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import CAMERAS, PIXELS, RenderOptions
from lerobot_bomb.commands.main import main
from lerobot_bomb.envs.rollout import Moment, expert_agent, make_env, run_episode
from lerobot_bomb.results.bomb import EpisodeResult
from lerobot_bomb.results.groups import groups_of
from lerobot_env_bomb.bomb.perturb import sample_episode
from lerobot_env_bomb.bomb.render import Renderer, renderer_of
from lerobot_env_bomb.bomb.sapien_render import SapienRenderer, device_name
from lerobot_env_bomb.bomb.scene import Scene
from lerobot_env_bomb.bomb.static_scene import starting_scene

SPEC = EpisodeSpec(seed=1000)
SIZE, LARGE = 64, 256


@pytest.fixture(scope="module", autouse=True)
def _driver() -> None:
    """Skip where nobody has named a Vulkan driver and none is found."""
    try:
        device_name()
    except ValueError as error:
        if "VK_ICD_FILENAMES" in os.environ:
            raise
        pytest.skip(f"{error} (bash .ci/lavapipe)")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene()


@pytest.fixture(scope="module")
def renderers(scene: Scene) -> Iterator[tuple[Renderer, Renderer]]:
    """MuJoCo's and SAPIEN's renderer of one scene."""
    options = [RenderOptions(SIZE, preset) for preset in ("fast", "sapien")]
    ours, theirs = (renderer_of(scene.model, each, LARGE) for each in options)
    yield ours, theirs
    ours.close()
    theirs.close()


def show(scene: Scene, perturbations: str = "none", suite: str = "place") -> None:
    episode = sample_episode(EpisodeSpec(seed=7, suite=suite, perturbations=perturbations))
    scene.reset(starting_scene(episode).layout, episode.perturbation.model_edits, episode.pattern)


@pytest.mark.parametrize("condition", ["none", "camera:5", "object:5", "stones:5+start:5"])
@pytest.mark.parametrize("camera", CAMERAS)
def test_the_same_shapes_are_where_they_are(
    condition: str, camera: str, scene: Scene, renderers: tuple[Renderer, Renderer]
) -> None:
    show(scene, condition)
    ours, theirs = (each.draw_geoms(scene.data, camera, LARGE) for each in renderers)
    for geom in np.unique(ours):
        here, there = ours == geom, theirs == geom
        if here.sum() >= 100:  # of fewer, the edge is a large part
            assert (here & there).sum() / (here | there).sum() > 0.9
    assert (ours == theirs).mean() > 0.985
    depths = [each.draw_depth(scene.data, camera, LARGE)[1] for each in renderers]
    assert np.median(np.abs(depths[0] - depths[1])) < 1e-4


@pytest.mark.parametrize(
    ("condition", "limit"),
    [
        ("none", 8),
        ("light:5", 8),
        ("table:5", 12),
        ("object:5", 8),
        ("reflectance:5", 20),
        ("goal_marker:1", 8),
    ],
)
def test_it_is_as_bright_and_in_the_same_colours(
    condition: str, limit: float, scene: Scene, renderers: tuple[Renderer, Renderer]
) -> None:
    show(scene, condition)
    for camera in CAMERAS:
        ours, theirs = (each.draw(scene.data, camera, SIZE).astype(float) for each in renderers)
        assert np.abs(ours - theirs).mean() < limit
        assert np.abs(ours.mean((0, 1)) - theirs.mean((0, 1))).max() < limit
        assert np.any(ours != theirs)


def test_the_pattern_in_the_tray_is_shown(scene: Scene, renderers: tuple[Renderer, Renderer]) -> None:
    show(scene, suite="goal")
    ours, theirs = (each.draw(scene.data, "workspace", LARGE).astype(float) for each in renderers)
    assert np.abs(ours - theirs).mean() < 8


def test_it_draws_the_same_bits_again_whatever_was_drawn_between(scene: Scene) -> None:
    show(scene)
    first, second = SapienRenderer(scene.model), SapienRenderer(scene.model)
    image = first.draw(scene.data, "workspace", SIZE)
    show(scene, "table:5+light:5")
    perturbed = first.draw(scene.data, "workspace", SIZE)
    assert np.abs(image.astype(int) - perturbed).mean() > 5
    second.draw(scene.data, "wrist", SIZE)
    show(scene)
    for each in (first, second):
        np.testing.assert_array_equal(image, each.draw(scene.data, "workspace", SIZE))


def run(spec: EpisodeSpec, preset: str, depth: bool = False) -> tuple[list[Moment], EpisodeResult]:
    env = make_env(spec, RenderOptions(SIZE, preset, depth))
    moments = list(run_episode(env, spec, expert_agent()))
    result = env.get_wrapper_attr("episode_result")()
    env.close()
    return moments, result


def test_pixels_and_physics_are_told_apart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    records = [
        run(replace(SPEC, seed=seed, simulator=simulator), preset)[1]
        for simulator in ("mujoco", "sapien")
        for preset in ("fast", "sapien")
        for seed in (1000, 1001)
    ]
    assert all(record.is_success for record in records)
    assert len(groups_of(records)) == 4
    assert [record.sapien_version for record in records[::2]] == [None, "3.0.3", "3.0.3", "3.0.3"]
    assert records[2].opengl_vendor == "Vulkan"
    path = tmp_path / "records.jsonl"
    path.write_text("".join(f"{record.to_json()}\n" for record in records))
    assert main(["compare", str(path), "--across=render_preset"]) == 0
    output = capsys.readouterr().out
    assert "render_preset fast, B is " in output
    assert output.count("2 successes each in 2 pairs") == 2


def test_states_are_those_of_the_episode_and_depth_is_observed() -> None:
    (first, *rest), result = run(SPEC, "fast")
    (drawn, *others), same = run(SPEC, "sapien", depth=True)
    assert (len(rest), result.placement_error_mm) == (len(others), same.placement_error_mm)
    np.testing.assert_array_equal(first.observation["agent_pos"], drawn.observation["agent_pos"])
    assert np.any(first.observation[PIXELS]["wrist"] != drawn.observation[PIXELS]["wrist"])
    assert drawn.observation["depth.wrist"].shape == (SIZE, SIZE)


def test_without_a_driver_it_says_what_is_missing(monkeypatch: pytest.MonkeyPatch, scene: Scene) -> None:
    def find() -> str:
        raise RuntimeError("failed to find a rendering device")

    monkeypatch.setattr(render, "get_device_summary", find)
    with pytest.raises(ValueError, match="it needs a Vulkan driver"):
        renderer_of(scene.model, RenderOptions(SIZE, "sapien"), SIZE)
