"""One episode run step by step, by any agent. This module imports neither torch nor LeRobot."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.expert import expert_action
from lerobot_bomb.bomb.observation import ENVIRONMENT_STATE, RenderOptions, action_bounds, max_step
from lerobot_bomb.bomb.privileged_state import PrivilegedState
from lerobot_bomb.envs.vector import FreezeAfterEnd
from lerobot_bomb.results.record import Spec

# Importing the part before the colon registers the id; no module of the core imports an environment.
ENV_ID = "lerobot_env_bomb:bomb/{suite}-v0"

# (observation of the environment, instruction) -> (D,) action
type Agent = Callable[[dict[str, Any], str], np.ndarray]
# the same of B environments: (B, D) actions
type BatchAgent = Callable[[list[dict[str, Any]], list[str]], np.ndarray]
# privileged state -> (4,) action
type Expert = Callable[[PrivilegedState], np.ndarray]


@dataclass(frozen=True)
class Moment:
    """Observation before a step, and the action that follows; an episode of T steps has T + 1 moments."""

    step: int
    instruction: str
    observation: dict[str, Any]
    info: dict[str, Any]
    action: np.ndarray | None  # (D,) the agent's, in the environment's units; None in the last moment

    @property
    def state(self) -> PrivilegedState:
        """BOMB's simulator's true state."""
        return PrivilegedState.from_vector(self.observation[ENVIRONMENT_STATE])


def make_env(spec: EpisodeSpec, render_options: RenderOptions) -> gymnasium.Env:
    """Make BOMB from Gymnasium's registry; it starts MuJoCo and OpenGL on its first reset."""
    return gymnasium.make(
        ENV_ID.format(suite=spec.suite),
        disable_env_checker=True,
        spec=spec,
        render_options=render_options,
    )


def run_episode(
    env: gymnasium.Env,
    spec: Spec,
    agent: Agent,
    disturb: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Iterator[Moment]:
    """Run a spec's episode in an `env` of that spec; yield each moment while `env` is in it.

    The executed action is the agent's, as `disturb` changes it. The last moment is the state after the last
    action.
    """
    observation, info = env.reset(seed=spec.seed)
    step, ended = 0, False
    while not ended:
        instruction = env.get_wrapper_attr("task_description")  # a later turn has another
        action = agent(observation, instruction)
        yield Moment(step, instruction, observation, info, action)
        executed = action if disturb is None else disturb(action)
        observation, _, terminated, truncated, info = env.step(executed)
        step, ended = step + 1, terminated or truncated
    yield Moment(step, env.get_wrapper_attr("task_description"), observation, info, None)


@contextmanager
def one_of_batch(
    agent: BatchAgent, make_env: Callable[[], gymnasium.Env], seed: int, row: int, size: int
) -> Iterator[Agent]:
    """Yield the agent of one seed, which at the same time acts in the other episodes of its batch.

    lerobot-eval runs consecutive seeds as a batch, in which a policy's arithmetic rounds differently than
    alone. The other episodes run here, unseen.
    """
    others = {i: FreezeAfterEnd(make_env()) for i in range(size) if i != row}
    seen = {i: env.reset(seed=seed - row + i)[0] for i, env in others.items()}

    def act(observation: dict[str, Any], instruction: str) -> np.ndarray:
        said = {i: env.get_wrapper_attr("task_description") for i, env in others.items()}
        observations, instructions = seen | {row: observation}, said | {row: instruction}
        actions = agent([observations[i] for i in range(size)], [instructions[i] for i in range(size)])
        for i, env in others.items():
            seen[i] = env.step(actions[i])[0]
        return actions[row]

    try:
        yield act
    finally:
        for env in others.values():
            env.close()


def expert_agent(expert: Expert = expert_action) -> Agent:
    """Return the scripted expert, which acts on the simulator's true state."""
    return lambda observation, _: expert(PrivilegedState.from_vector(observation[ENVIRONMENT_STATE]))


def random_agent(env: gymnasium.Env, seed: int) -> Agent:
    """Return an agent that draws actions uniformly from the action space, the same for the same seed."""
    env.action_space.seed(seed)
    return lambda *_: env.action_space.sample()


def add_noise(action: np.ndarray, noise: float, control_mode: str, rng: np.random.Generator) -> np.ndarray:
    """(D,) action -> (D,) float32 within its bounds, with Gaussian noise on all numbers but the gripper's.

    `noise` is its standard deviation in units of the largest relative step. The gripper's command is left
    alone: its sign opens or closes, so noise on it would drop the stone and not merely push the arm off its
    path.
    """
    offset = np.append(noise * max_step(control_mode) * rng.standard_normal(len(action) - 1), 0.0)
    low, high = action_bounds(control_mode)
    return np.clip(action + offset, low, high).astype(np.float32)
