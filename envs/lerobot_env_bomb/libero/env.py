"""LIBERO with BOMB's perturbation axes, as a Gymnasium environment."""

from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np

from lerobot_bomb.bomb.observation import ENVIRONMENT_STATE
from lerobot_bomb.envs.episode_env import EpisodeEnv, Observation, Transition
from lerobot_bomb.envs.perturbation import transforms_of
from lerobot_bomb.libero.episode import (
    MOTION_DIMS,
    LiberoFailure,
    LiberoSpec,
    initial_state_of,
    libero_failure_of,
)
from lerobot_bomb.libero.expert import LiberoState
from lerobot_bomb.results.libero import LiberoResult
from lerobot_bomb.results.origin import PolicyIdentity
from lerobot_env_bomb.libero.actuator import LiberoActuator
from lerobot_env_bomb.libero.axes.dynamics import LiberoDynamics
from lerobot_env_bomb.libero.episode import LiberoEpisode, sample_libero_episode
from lerobot_env_bomb.libero.expert.guide import Guide
from lerobot_env_bomb.libero.scene import LiberoScene


@dataclass(frozen=True)
class _Run:
    """State of an episode that has been started."""

    episode: LiberoEpisode
    actuator: LiberoActuator | None  # None: actions are executed as they are
    touched: set[str]  # objects and fixtures that the gripper has touched
    guide: Guide | None = None  # the scripted expert's plan


class BombLiberoEnv(EpisodeEnv[LiberoSpec, _Run, LiberoResult]):
    """Task: the suite's, as LeRobot's `libero` has it.

    Randomizations: one of the task's recorded initial states, by the seed. Without perturbations an
    episode is LeRobot's of the same initial state and seed: images, states, rewards and end.

    Action: (7,) -1..1, the arm's relative motion in x, y, z and orientation, and the gripper, 1 to close.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 80}  # noqa: RUF012
    gripper_dims = (6,)

    def __init__(
        self,
        spec: LiberoSpec,
        scene: dict[str, Any],
        results_path: str | None = None,
        render_mode: str | None = "rgb_array",
        policy: PolicyIdentity | None = None,
        is_guided: bool = False,
        draws: bool = True,
    ):
        """Make the environment of a task.

        Args:
            spec: of its episodes, which differ in their seeds.
            scene: arguments of LeRobot's environment beside suite and task.
            results_path: file that gets a record of each episode.
            render_mode: as Gymnasium has it.
            policy: that acts, for the records.
            is_guided: add what the scripted expert reads to observations, as `environment_state`.
            draws: draw the images of observations, most of a step's time; else they are black.
        """
        from libero.libero import benchmark  # slow

        suite = benchmark.get_benchmark_dict()[spec.suite]()
        self._scene = LiberoScene(
            list(transforms_of(spec.condition).values()),
            draws,
            task_suite=suite,
            task_id=spec.task_id,
            task_suite_name=spec.suite,
            episode_length=spec.max_steps,
            **scene,
        )
        super().__init__(spec, self._scene.task, results_path, render_mode)
        self.task_description = self._instruction = self._scene.task_description
        self._max_episode_steps = self._scene._max_episode_steps
        self._policy = policy
        self._is_success = False
        self.action_space, self.observation_space = self._scene.action_space, self._scene.observation_space
        self._is_guided = is_guided
        if is_guided:
            state = gymnasium.spaces.Box(-np.inf, np.inf, (LiberoState.DIM,), np.float32)
            shown: Any = self._scene.observation_space
            self.observation_space = gymnasium.spaces.Dict({**shown.spaces, ENVIRONMENT_STATE: state})

    def _begin(self, spec: LiberoSpec) -> tuple[Observation, dict[str, Any]]:
        episode = sample_libero_episode(spec, self._instruction)
        observation = self._scene.begin(spec.seed, tuple(episode.perturbation.transforms.values()))
        dynamics = episode.perturbation.of(LiberoDynamics)
        actuator = None if dynamics is None else LiberoActuator(dynamics, spec.seed)
        guide = Guide(self._scene) if self._is_guided else None
        self._current_run = _Run(episode, actuator, set(), guide)
        self._is_success = False
        self.task_description = episode.instruction
        return self._sensed(observation), {"is_success": False, "failure": "", "seed": spec.seed}

    def _advance(self, run: _Run, action: np.ndarray) -> Transition:
        command = run.actuator.command(action) if run.actuator else action
        observation, reward, terminated, _, info = self._scene.step(command)
        self._is_success = bool(info["is_success"])
        run.touched.update(self._scene.touched())
        truncated = self._steps >= self._max_episode_steps
        info |= {
            "failure": str(self._failure or "") if terminated or truncated else "",
            "seed": run.episode.spec.seed,
        }
        return self._sensed(observation), float(reward), bool(terminated), truncated, info

    def _draw_for_people(self, run: _Run) -> np.ndarray:
        """(H, W, 3) uint8: the scene's camera, upright."""
        return run.episode.perturbation.sense(self._scene.render(), self._steps)

    def _result(self, run: _Run) -> LiberoResult:
        episode, scene = run.episode, self._scene
        return LiberoResult(
            spec=episode.spec,
            instruction=episode.instruction,
            initial_state=initial_state_of(episode.spec.seed, scene.num_initial_states),
            steps=self._steps,
            is_success=self._is_success,
            failure=self._failure,
            levels=dict(episode.perturbation.levels),
            image_size=f"{scene.observation_width}x{scene.observation_height}",
            render_preset=scene.render_preset,
            control_mode=scene.control_mode,
            fps=scene.control_freq,
            policy=self._policy,
        )

    def close(self) -> None:
        """Free robosuite's resources, and with them the episode."""
        self._scene.close()
        self._current_run = None  # its simulator is gone; another one would step in its place

    @property
    def _failure(self) -> LiberoFailure | None:
        """Reason why the episode failed, were it to end now."""
        if self._is_success:
            return None
        if (guide := self._run.guide) is not None and guide.failure is not None:
            return guide.failure
        return libero_failure_of(self._run.touched, self._scene.wanted)

    def _sensed(self, observation: Observation) -> Observation:
        """Return LeRobot's observation with its images as the cameras' sensors take them in this step."""
        sense = self._run.episode.perturbation.sense
        pixels = {name: sense(image, self._steps) for name, image in observation["pixels"].items()}
        observation = observation | {"pixels": pixels}
        if (guide := self._run.guide) is None:
            return observation
        pending = np.zeros(MOTION_DIMS) if self._run.actuator is None else self._run.actuator.pending
        return observation | {ENVIRONMENT_STATE: guide.state(pending).to_vector()}
