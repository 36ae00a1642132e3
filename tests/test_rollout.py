"""Episodes that the recorder runs, and their noise."""

import itertools
import multiprocessing
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace

import gymnasium
import numpy as np
import pytest

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.expert import expert_action
from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.bomb.privileged_state import PrivilegedState
from lerobot_bomb.data.rollout_pool import RolloutPool, RolloutSettings, collect
from lerobot_bomb.envs.rollout import add_noise, make_env

SMALL = RenderOptions(image_size=64)


class ExecutedActions(gymnasium.Wrapper):
    """Notes what the environment is told to do, and the state in which it is told."""

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        self.actions: list[np.ndarray] = []
        self.states: list[PrivilegedState] = []

    def step(self, action: np.ndarray):
        self.actions.append(action)
        self.states.append(self.env.get_wrapper_attr("privileged_state")())
        return super().step(action)


def test_noise_is_executed_but_not_stored() -> None:
    spec, settings = EpisodeSpec(seed=0), RolloutSettings(SMALL, noise=0.1)
    env = ExecutedActions(make_env(spec, SMALL))
    rollout = collect(env, spec, settings)
    assert rollout.result.is_success
    clean = np.stack([expert_action(PrivilegedState.from_vector(s.to_vector())) for s in env.states])
    executed = np.stack(env.actions)
    assert np.array_equal(rollout.actions, clean)
    assert np.array_equal(executed[:, 3], clean[:, 3])
    assert 0.05 < np.std(executed[:, :3] - clean[:, :3]) < 0.15

    again = collect(env, spec, settings)
    other = collect(env, replace(spec, seed=1), settings)
    env.close()
    assert np.array_equal(again.actions, rollout.actions)
    assert np.array_equal(again.frames["wrist"], rollout.frames["wrist"])
    assert not np.array_equal(other.actions[:5], rollout.actions[:5])


@pytest.mark.parametrize(("control_mode", "step"), [("relative", 1.0), ("absolute", 0.04)])
def test_noise_has_the_same_size_in_both_control_modes(control_mode: str, step: float) -> None:
    action = np.array([0, 0, 0.1, -1], dtype=np.float32)
    rng = np.random.default_rng(0)
    draws = np.stack([add_noise(action, 0.05, control_mode, rng) for _ in range(500)])
    assert np.std(draws[:, :3], axis=0) == pytest.approx([0.05 * step] * 3, rel=0.15)
    assert (draws[:, 3] == -1).all()
    assert np.array_equal(add_noise(action, 0.0, control_mode, rng), action)


def test_a_pool_yields_in_the_order_of_the_specs() -> None:
    specs = [EpisodeSpec(seed=seed, target=(seed % 2, 3)) for seed in range(7, 20)]
    with RolloutPool(RolloutSettings(SMALL), iter(specs), num_workers=2) as pool:
        rollouts = [rollout for rollout, _ in zip(pool, range(5), strict=False)]
    assert [rollout.result.spec for rollout in rollouts] == specs[:5]
    assert [rollout.result.target for rollout in rollouts] == [(1, 3), (0, 3), (1, 3), (0, 3), (1, 3)]
    assert rollouts[0].frames["workspace"].shape == (rollouts[0].result.steps, 64, 64, 3)


def test_a_pool_that_is_iterated_block_by_block_goes_on_and_runs_no_further_ahead() -> None:
    drawn = []

    def specs() -> Iterator[EpisodeSpec]:
        for seed in itertools.count():
            drawn.append(seed)
            yield EpisodeSpec(seed=seed)

    with RolloutPool(RolloutSettings(SMALL), specs(), num_workers=2) as pool:
        seeds = [rollout.result.spec.seed for _ in range(3) for rollout in itertools.islice(pool, 1)]
    assert seeds == [0, 1, 2]
    assert len(drawn) == 2 * 2 + 3  # two per worker under way


def test_workers_start_without_torch_and_lerobot() -> None:
    script = (
        "import sys, lerobot_bomb.data.record, lerobot_bomb.envs.rollout as rollout\n"
        "from lerobot_bomb.bomb.episode import EpisodeSpec\n"
        "from lerobot_bomb.bomb.observation import RenderOptions\n"
        "rollout.make_env(EpisodeSpec(seed=0), RenderOptions()).reset()\n"
        "assert not {'torch', 'lerobot'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True)


def test_a_worker_that_ends_is_reported_and_the_others_are_ended() -> None:
    specs = (EpisodeSpec(seed=seed) for seed in itertools.count())
    with RolloutPool(RolloutSettings(RenderOptions(image_size=256)), specs, num_workers=2) as pool:
        next(pool)
        processes = multiprocessing.active_children()
        time.sleep(0.5)  # more than a pipe holds: both are sending their next episode
        processes[0].terminate()
        with pytest.raises(RuntimeError, match="a simulator process ended with exit code -15"):
            list(pool)
    assert [process.is_alive() for process in processes] == [False, False]


def test_an_error_in_a_worker_is_raised() -> None:
    settings = RolloutSettings(SMALL, expert=forgets_the_gripper)
    with (
        RolloutPool(settings, iter([EpisodeSpec(seed=0)] * 9), num_workers=1) as pool,
        pytest.raises(ValueError, match=r"\(3,\)"),
    ):
        next(pool)


def forgets_the_gripper(state: PrivilegedState) -> np.ndarray:
    return expert_action(state)[:3]
