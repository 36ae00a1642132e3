"""Leaks: an episode's request is told by its instruction, and shows in nothing but board and tray."""

from dataclasses import replace

import numpy as np
import pytest

import lerobot_env_bomb.bomb.env
from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import AGENT_POS, PIXELS, RenderOptions
from lerobot_bomb.bomb.perturbations import AXES, NUISANCES
from lerobot_bomb.bomb.suites import SUITES
from lerobot_env_bomb.bomb.env import BombEnv
from lerobot_env_bomb.bomb.perturb import PerturbedEpisode, draw_perturbation, sample_episode

MARKER = "goal_marker"
VISUAL_AXES = [axis for axis in NUISANCES if AXES[axis].changes == ("images",)]
ASKED_SEED = 104  # its last move goes elsewhere than that of SEED in every suite
SEED = 3
NUM_EPISODES = 600
NUM_DEVIATIONS = 4.5  # that chance may give


@pytest.fixture(params=SUITES)
def suite(request: pytest.FixtureRequest) -> str:
    return request.param


def start(spec: EpisodeSpec, asked_seed: int, monkeypatch: pytest.MonkeyPatch) -> dict[str, np.ndarray]:
    """Return what a spec's scene shows at the start, if it goes with what another seed's episode asks for."""
    other = sample_episode(replace(spec, seed=asked_seed))
    asked = {name: getattr(other, name) for name in ("task_id", "turns", "plans", "aims", "target", "color")}
    episode = replace(sample_episode(spec), **asked)
    episode = replace(episode, perturbation=draw_perturbation(episode))
    env = BombEnv(spec, RenderOptions(image_size=64))
    with monkeypatch.context() as patch:
        patch.setattr(lerobot_env_bomb.bomb.env, "sample_episode", lambda _: episode)
        observation, _ = env.reset(seed=spec.seed)
    env.close()
    return observation[PIXELS] | {AGENT_POS: observation[AGENT_POS]}


@pytest.mark.parametrize("axis", [*VISUAL_AXES, MARKER])
def test_images_and_arm_show_what_is_asked_for_with_the_marker_only(
    suite: str, axis: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = EpisodeSpec(SEED, suite, perturbations=f"{axis}:3")
    one, other = (start(spec, asked_seed, monkeypatch) for asked_seed in (SEED, ASKED_SEED))
    is_same = [np.array_equal(one[key], other[key]) for key in one]
    assert all(is_same) == (axis != MARKER)


def test_where_gripper_and_tray_start_tells_nothing_of_what_is_asked_for(suite: str) -> None:
    episodes = [sample_episode(EpisodeSpec(seed, suite)) for seed in range(NUM_EPISODES)]
    assert_uncorrelated([episode.layout.gripper_xyz for episode in episodes], episodes)
    if with_supply := [episode for episode in episodes if episode.supply and not episode.pattern]:
        supplies = [episode.layout.stone_xy[list(episode.supply)].mean(0) for episode in with_supply]
        assert_uncorrelated(supplies, with_supply)


def assert_uncorrelated(starts: list[np.ndarray], episodes: list[PerturbedEpisode]) -> None:
    """Assert that `starts` tell nothing of the request: the first stone's goal, turns, template, task."""
    asked = np.array(
        [
            (*episode.aims[0].xy, len(episode.turns), len(episode.instruction), episode.task_id)
            for episode in episodes
        ]
    )
    asked = asked[:, asked.std(axis=0) > 0]
    num_starts = len(starts[0])
    together = np.corrcoef(np.array(starts), asked, rowvar=False)
    assert abs(together[:num_starts, num_starts:]).max() < NUM_DEVIATIONS / np.sqrt(len(episodes))
