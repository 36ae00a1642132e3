"""Does LeRobot's environment `pusht` show and do what the demonstrations hold?"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from pusht_cases import Demonstrations, put

gym_pusht = pytest.importorskip("gym_pusht")

from gymnasium.spaces import Box  # noqa: E402
from gymnasium.vector import SyncVectorEnv  # noqa: E402
from lerobot.envs.configs import PushtEnv  # noqa: E402
from lerobot.envs.utils import preprocess_observation  # noqa: E402

MIN_PSNR_DB = 36  # seen: 38 to 53; lines differ in single pixels between versions of pygame
MAX_WRONG_PSNR_DB = 30  # BGR gave at most 29.5, x and y swapped 23.7
MAX_DRIFT = 1e-3  # pixels; seen: 1.6e-5 over whole episodes


@pytest.fixture(scope="module")
def vector_env() -> Iterator[SyncVectorEnv]:
    """Make the environment as lerobot-eval --env.type=pusht does."""
    env = PushtEnv().create_envs(n_envs=1)["pusht"][0]
    assert isinstance(env, SyncVectorEnv)
    yield env
    env.close()


def set_state(env: SyncVectorEnv, state: np.ndarray) -> None:
    """Put agent and block where `state` (5) says."""
    env.reset(seed=0)
    put(env.envs[0].unwrapped, state)


def policy_view(env: SyncVectorEnv) -> tuple[np.ndarray, np.ndarray]:
    """Return what a policy sees: the image (96, 96, 3) in 0..255 and the state (2)."""
    pusht: Any = env.envs[0].unwrapped
    raw = pusht.get_obs()
    observation = preprocess_observation({key: value[None] for key, value in raw.items()})
    assert set(observation) == {"observation.image", "observation.state"}
    image = observation["observation.image"][0].numpy().transpose(1, 2, 0) * 255
    return image, observation["observation.state"][0].numpy()


def psnr_db(image: np.ndarray, other: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.mean((image - other) ** 2)))


def test_the_environment_draws_a_state_as_the_demonstrations_do(
    vector_env: SyncVectorEnv, pusht_demonstrations: Demonstrations
) -> None:
    for step in range(0, len(pusht_demonstrations.actions), 60):
        set_state(vector_env, pusht_demonstrations.states[step])
        image, state = policy_view(vector_env)
        stored = pusht_demonstrations.images[step]
        np.testing.assert_array_equal(state, pusht_demonstrations.states[step, :2])
        assert image.shape == stored.shape
        assert psnr_db(image, stored) > MIN_PSNR_DB
        assert psnr_db(image[..., ::-1], stored) < MAX_WRONG_PSNR_DB
        assert psnr_db(image.transpose(1, 0, 2), stored) < MAX_WRONG_PSNR_DB


def test_recorded_actions_lead_through_the_recorded_states(
    vector_env: SyncVectorEnv, pusht_demonstrations: Demonstrations
) -> None:
    states, actions = pusht_demonstrations.states, pusht_demonstrations.actions
    set_state(vector_env, states[0])
    pusht: Any = vector_env.envs[0].unwrapped
    for step in range(pusht_demonstrations.ends[0] - 1):
        observation, *_ = vector_env.step(actions[None, step])
        np.testing.assert_allclose(observation["agent_pos"][0], states[step + 1, :2], rtol=0, atol=MAX_DRIFT)
        np.testing.assert_allclose(pusht.block.position, states[step + 1, 2:4], rtol=0, atol=MAX_DRIFT)


def test_the_environment_names_no_task(vector_env: SyncVectorEnv) -> None:
    """Check why lerobot-eval gives a policy the empty text, which is what `convert` writes."""
    for name in ("task_description", "task"):
        with pytest.raises(AttributeError):
            vector_env.call(name)


def test_the_action_space_is_the_range_that_convert_accepts(vector_env: SyncVectorEnv) -> None:
    from lerobot_bomb.data.pusht_zarr import BOARD_SIZE

    space = vector_env.single_action_space
    assert isinstance(space, Box)
    assert (space.low == 0).all() and (space.high == BOARD_SIZE).all()
