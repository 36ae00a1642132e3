import os
import signal
import sys
from functools import partial
from multiprocessing import active_children
from pathlib import Path

import numpy as np
import pytest

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.envs.vector import NEW_ROLLOUT_OPTION, FreezeAfterEnd, LazyVectorEnv
from lerobot_bomb.results.bomb import EpisodeResult
from lerobot_bomb.results.groups import read_results
from lerobot_bomb.results.inference import Query
from lerobot_bomb.results.origin import Evaluation
from lerobot_env_bomb.bomb.env import BombEnv

SMALL = RenderOptions(image_size=32)
SEEDS = [11, 12]
STILL = np.zeros((2, 4), dtype=np.float32)


def make_one(**spec: object) -> BombEnv:
    return BombEnv(spec=EpisodeSpec(**{"seed": 0, **spec}), render_options=SMALL)  # pyright: ignore[reportArgumentType]


def ended_env() -> FreezeAfterEnd:
    """An environment whose episode of seed 1 has ended."""
    env = FreezeAfterEnd(make_one(fps=1))
    env.reset(seed=1)
    ended = False
    while not ended:
        *_, terminated, truncated, _ = env.step(STILL[0])
        ended = terminated or truncated
    return env


def test_workers_import_neither_torch_nor_lerobot() -> None:
    envs = LazyVectorEnv([partial(ImportSpy, EpisodeSpec(seed=0), SMALL)] * 2, use_async=True)
    try:
        assert envs.call("heavy_modules") == ([], [])
    finally:
        envs.close()


def test_ctrl_c_which_a_terminal_sends_to_workers_too_does_not_end_them() -> None:
    envs = LazyVectorEnv([partial(ImportSpy, EpisodeSpec(seed=0), SMALL)] * 2, use_async=True)
    try:
        envs.reset(seed=SEEDS)
        workers = [worker.pid for worker in active_children() if worker.pid]
        assert len(workers) == 2
        for pid in workers:
            os.kill(pid, signal.SIGINT)
        assert envs.step(STILL)[1].tolist() == [0, 0]
    finally:
        envs.close()


class ImportSpy(BombEnv):
    """Tells what its process has imported."""

    def heavy_modules(self) -> list[str]:
        return [name for name in ("torch", "lerobot", "transformers") if name in sys.modules]


def test_nothing_starts_before_the_first_use() -> None:
    started = []

    def make() -> BombEnv:
        started.append(1)
        return make_one()

    envs = LazyVectorEnv([make] * 2, use_async=False)
    assert len(started) == 1  # the probe for the spaces, closed again
    assert envs.observation_space["agent_pos"].shape == (2, 4)  # pyright: ignore[reportIndexIssue]
    envs.reset(seed=SEEDS)
    assert len(started) == 3
    envs.close()


class Queried(BombEnv):
    """Tells of which queries it was told."""

    def queries(self) -> list[Query]:
        return list(self._queries)


def test_a_query_before_a_reset_is_of_no_episode_after_it() -> None:
    before, after = (Query(seconds, None, None, 1, None, "cpu") for seconds in (1.0, 2.0))
    asked = [before]
    make = partial(Queried, EpisodeSpec(seed=0), SMALL)
    envs = LazyVectorEnv([make] * 2, use_async=False, last_query=lambda: asked.pop() if asked else None)
    envs.reset(seed=SEEDS)
    envs.step(STILL)
    assert envs.call("queries") == ([], [])
    asked.append(after)
    envs.step(STILL)
    envs.step(STILL)
    assert envs.call("queries") == ([after], [after])
    envs.close()


def test_an_ended_episode_stays_frozen_through_autoreset() -> None:
    envs = LazyVectorEnv([partial(make_one, fps=1)] * 2, use_async=False)  # fps 1: ends after 10 steps
    envs.reset(seed=SEEDS, options={NEW_ROLLOUT_OPTION: True})
    while True:
        observation, _, terminated, truncated, info = envs.step(STILL)
        if (terminated | truncated).all():
            break
    last = observation["agent_pos"].copy()
    for _ in range(3):
        observation, reward, *_, info = envs.step(STILL + 1)
        np.testing.assert_array_equal(observation["agent_pos"], last)
        assert reward.tolist() == [0, 0]
        assert info["seed"].tolist() == SEEDS
    observation, info = envs.reset(seed=[21, 22], options={NEW_ROLLOUT_OPTION: True})
    assert info["seed"].tolist() == [21, 22]
    envs.close()


@pytest.mark.parametrize("use_async", [False, True])
def test_what_an_evaluation_does_not_count_leaves_no_record(use_async: bool, tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    make = partial(BombEnv, EpisodeSpec(seed=0, fps=1), SMALL, str(path))
    envs = LazyVectorEnv([make] * 2, use_async, num_tasks=4)

    def play(*seeds: int) -> None:
        envs.reset(seed=list(seeds))
        for _ in range(10):
            envs.step(STILL)

    envs.begin_evaluation(num_episodes=3, seed=11)
    play(11, 12)
    play(13, 14)
    play(15, 16)  # of none
    envs.close()
    of_evaluation = {each.spec.seed: each.evaluation for each in read_results(path, EpisodeResult)}
    expected = dict.fromkeys((11, 12, 13), Evaluation(num_episodes=12, seed=11))
    assert of_evaluation == expected | {15: None, 16: None}


def test_changing_a_frozen_observation_changes_no_later_one() -> None:
    env = ended_env()
    expected = env.reset()[0]["agent_pos"].copy()
    env.reset()[0]["agent_pos"][:] = 0
    np.testing.assert_array_equal(env.reset()[0]["agent_pos"], expected)
    env.close()


@pytest.mark.parametrize("use_async", [False, True])
def test_without_seeds_every_environment_runs_episodes_of_its_own(use_async: bool) -> None:
    """A reset of the vector environment starts new ones, where the last have ended, too."""
    envs = LazyVectorEnv([partial(make_one, fps=1)] * 2, use_async)
    seeds = [*envs.reset()[1]["seed"]]
    for _ in range(10):
        _, _, _, truncated, info = envs.step(STILL)
    assert truncated.all() and [*info["seed"]] == seeds
    seeds += [*envs.reset()[1]["seed"]]
    assert len(set(seeds)) == 4
    repeated = [(envs.reset(seed=seed)[1]["seed"], envs.reset()[1]["seed"]) for seed in (3, np.int64(3))]
    envs.close()
    assert repeated[0][0].tolist() == [3, 4] and repeated[0][1][0] != repeated[0][1][1]
    np.testing.assert_array_equal(repeated[0], repeated[1])


@pytest.mark.filterwarnings("ignore")  # Gymnasium's report of the error
@pytest.mark.parametrize("use_async", [False, True])
def test_after_an_error_it_can_be_reset(use_async: bool) -> None:
    envs = LazyVectorEnv([make_one] * 2, use_async)
    for _ in range(2):
        assert envs.reset(seed=SEEDS)[1]["seed"].tolist() == SEEDS
        with pytest.raises(ValueError, match="is not finite"):
            envs.step(STILL * [[1], [np.nan]])
    with pytest.raises(TypeError, match="must be a whole number"):
        envs.reset(seed=[1, 1.5])
    assert envs.reset(seed=SEEDS)[1]["seed"].tolist() == SEEDS
    assert envs.step(STILL)[4]["seed"].tolist() == SEEDS
    envs.close()


def test_freezing_uses_lerobots_option_name() -> None:
    from lerobot.envs.utils import NEW_ROLLOUT_OPTION as LEROBOTS

    assert LEROBOTS == NEW_ROLLOUT_OPTION


def test_a_seed_or_the_option_starts_a_new_episode() -> None:
    env = ended_env()
    assert env.reset()[1]["seed"] == 1
    assert env.reset(seed=2)[1]["seed"] == 2
    assert env.reset(options={NEW_ROLLOUT_OPTION: True})[1]["seed"] != 1
    env.close()
