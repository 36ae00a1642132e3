"""One episode, moment by moment, played by whatever acts."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np

from lerobot_bomb.bomb.episode import EpisodeSpec
from lerobot_bomb.bomb.expert import expert_action
from lerobot_bomb.bomb.observation import PrivilegedState

# (observation of the environment, instruction) -> (4,) action
type Agent = Callable[[dict[str, Any], str], np.ndarray]


@dataclass(frozen=True)
class Moment:
    """What is seen before a step, and what is then done; an episode of T steps has T + 1 moments."""

    step: int
    instruction: str
    observation: dict[str, Any]
    info: dict[str, Any]
    action: np.ndarray | None  # (4,) in the environment's units; None in the last moment

    @property
    def state(self) -> PrivilegedState:
        """The simulator's true state."""
        return PrivilegedState.from_vector(self.observation["environment_state"])


def play(env: gymnasium.Env, spec: EpisodeSpec, agent: Agent) -> Iterator[Moment]:
    """Play a spec's episode in an `env` of that spec; while a moment is looked at, `env` is in it.

    The last moment is what the last action led to, which lerobot-eval's videos cut off.
    """
    observation, info = env.reset(seed=spec.seed)
    instruction = env.get_wrapper_attr("task_description")
    step, ended = 0, False
    while not ended:
        action = agent(observation, instruction)
        yield Moment(step, instruction, observation, info, action)
        observation, _, terminated, truncated, info = env.step(action)
        step, ended = step + 1, terminated or truncated
    yield Moment(step, instruction, observation, info, None)


def expert_agent(spec: EpisodeSpec) -> Agent:
    """The scripted expert, which acts on the simulator's true state."""
    return lambda observation, _: expert_action(
        PrivilegedState.from_vector(observation["environment_state"]), spec.control_mode, spec.fps
    )


def random_agent(env: gymnasium.Env, spec: EpisodeSpec) -> Agent:
    """Actions drawn uniformly from the action space, the same for the same seed."""
    env.action_space.seed(spec.seed)
    return lambda *_: env.action_space.sample()
