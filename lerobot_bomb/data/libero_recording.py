"""Parameters of a recording of LIBERO's scripted expert, and its episodes as workers run them."""

from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium
import numpy as np

from lerobot_bomb import __version__
from lerobot_bomb.bomb.observation import ENVIRONMENT_STATE, PIXELS
from lerobot_bomb.bomb.streams import recorder_noise
from lerobot_bomb.conditions import NONE
from lerobot_bomb.data.base_recording import BaseRecording
from lerobot_bomb.envs.rollout import Agent, Expert, run_episode
from lerobot_bomb.flags import one_of
from lerobot_bomb.libero.assets import SUITES
from lerobot_bomb.libero.episode import (
    LIBERO_PROTOCOL_VERSION,
    MOTION_DIMS,
    RENDER_PRESETS,
    TASKS_PER_SUITE,
    LiberoSpec,
)
from lerobot_bomb.libero.expert import LiberoState, libero_expert_action
from lerobot_bomb.results.libero import SIMULATOR, LiberoResult
from lerobot_bomb.results.origin import installed_versions

if TYPE_CHECKING:
    from lerobot_bomb.data.blocks import DatasetLayout, RecordedEpisode

# Importing the part before the colon registers the id; no module of the core imports an environment.
ENV_ID = "lerobot_env_bomb:bomb_libero/Libero-v0"
IMAGE_SIZE = ("observation_height", "observation_width")
IMAGE_NAMES = ("image", "image2")  # of LeRobot's environment


@dataclass(frozen=True)
class LiberoRecording(BaseRecording):
    """Parameters that determine a recording of LIBERO frame by frame."""

    task: str = SUITES[0]
    task_ids: tuple[int, ...] = ()  # in the suite, each run from every seed; empty: all
    perturbations: tuple[str, ...] = (NONE,)  # conditions, each run from every seed, with every task
    images: bool = False
    observation_height: int = 256
    observation_width: int = 256
    render_preset: str = RENDER_PRESETS[0]
    noise: float = 0.0
    env_type: str = LiberoResult.env_type
    protocol_version: str = LIBERO_PROTOCOL_VERSION
    package_version: str = __version__
    # other ones give other bits
    simulator_versions: dict[str, str | None] = field(default_factory=partial(installed_versions, SIMULATOR))

    def __post_init__(self) -> None:
        self._check(self.perturbations, self.noise)
        one_of("--env.render_preset", self.render_preset, RENDER_PRESETS)
        for name in IMAGE_SIZE:
            if getattr(self, name) < 1:
                raise ValueError(f"--env.{name}={getattr(self, name)} must be at least 1")
        if len(set(self.conditions)) < len(self.conditions):
            raise ValueError("--env.perturbations or --env.task_ids names something twice")

    @property
    def conditions(self) -> list[LiberoSpec]:
        """Return the specs that every seed is run with; they hold the first seed."""
        tasks = self.task_ids or range(TASKS_PER_SUITE.get(self.task, 1))
        return [
            LiberoSpec(self.seed, self.task, task_id, perturbations=condition)
            for task_id in tasks
            for condition in self.perturbations
        ]

    def rollouts(self, _: Expert) -> "LiberoRollouts":
        drawn = {name: getattr(self, name) for name in (*IMAGE_SIZE, "render_preset")}
        return LiberoRollouts(self.noise, {"obs_type": "pixels_agent_pos"} | drawn)

    def layout(self) -> "DatasetLayout":
        from lerobot_bomb.data.libero_conversion import libero_layout  # LeRobot: seconds

        shape = (self.observation_height, self.observation_width, 3)
        return libero_layout(self.repo_id, shape, use_videos=not self.images)


@dataclass(frozen=True)
class LiberoRollout:
    """One episode of T steps. A failed episode has a result only, and T = 0."""

    result: LiberoResult
    instruction: str
    robot_states: list[dict[str, Any]]  # T, as the environment gives them
    actions: list[np.ndarray]  # T of (7,) float32, the expert's clean actions
    frames: dict[str, list[np.ndarray]]  # name -> T of (H, W, 3) uint8, as a policy sees them

    @property
    def num_steps(self) -> int:
        """Number of frames to store."""
        return len(self.actions)

    def episode(self) -> "RecordedEpisode":
        """Return the episode that the dataset stores."""
        from lerobot_bomb.data.libero_dataset import libero_episode  # LeRobot: seconds

        return libero_episode(self)


@dataclass(frozen=True)
class LiberoRollouts:
    """Settings of LIBERO's rollouts."""

    max_envs: ClassVar[int] = 10  # a suite's tasks

    noise: float  # standard deviation on the motion, in units of the largest
    scene: dict[str, Any]  # arguments of LeRobot's environment

    def make_env(self, spec: LiberoSpec) -> gymnasium.Env:
        return gymnasium.make(ENV_ID, disable_env_checker=True, spec=spec, scene=self.scene, is_guided=True)

    def collect(self, env: gymnasium.Env, spec: LiberoSpec, agent: Agent | None = None) -> LiberoRollout:
        """Run the expert, or an agent, in a spec's episode; the executed actions carry the noise."""
        rng = recorder_noise(spec.seed)
        moments = list(run_episode(env, spec, agent or _act, disturb=partial(self._disturb, rng)))
        result = env.get_wrapper_attr("episode_result")()
        shown = moments[:-1] if result.is_success else []
        return LiberoRollout(
            result,
            moments[0].instruction,
            [moment.observation["robot_state"] for moment in shown],
            [moment.action for moment in shown if moment.action is not None],
            {
                # LeRobot's processor turns the simulator's images by 180 degrees
                name: [moment.observation[PIXELS][name][::-1, ::-1] for moment in shown]
                for name in IMAGE_NAMES
            },
        )

    def _disturb(self, rng: np.random.Generator, action: np.ndarray) -> np.ndarray:
        """(7,) action -> (7,) float32 with noise on its motion; the gripper's command is left alone."""
        offset = np.append(self.noise * rng.standard_normal(MOTION_DIMS), 0.0)
        return np.clip(action + offset, -1, 1).astype(np.float32)


def _act(observation: dict[str, Any], _: str) -> np.ndarray:
    return libero_expert_action(LiberoState.from_vector(observation[ENVIRONMENT_STATE]))
