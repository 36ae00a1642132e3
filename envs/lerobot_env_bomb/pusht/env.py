"""PushT with BOMB's perturbation axes, as a Gymnasium environment."""

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from gymnasium import spaces

from lerobot_bomb.envs.episode_env import EpisodeEnv, Observation, Transition
from lerobot_bomb.pusht.episode import (
    BOARD_PX,
    FPS,
    IMAGE_SIZE,
    PushTFailure,
    PushTSpec,
    check_image_size,
    pusht_failure_of,
)
from lerobot_bomb.results.origin import PolicyIdentity
from lerobot_bomb.results.pusht import PushTResult
from lerobot_env_bomb.pusht.actuator import PushTActuator
from lerobot_env_bomb.pusht.axes.dynamics import PushTDynamics
from lerobot_env_bomb.pusht.board import Board
from lerobot_env_bomb.pusht.episode import PushTEpisode, sample_pusht_episode

REACH_PX = (-BOARD_PX, 2 * BOARD_PX)  # of the agent, which passes through the board's walls
DEFAULT_PUSHT_SPEC = PushTSpec(seed=0)


@dataclass(frozen=True)
class _Run:
    """State of an episode that has been started."""

    episode: PushTEpisode
    block_pose: np.ndarray  # (3,)
    actuator: PushTActuator | None  # None: actions are executed as they are


class BombPushTEnv(EpisodeEnv[PushTSpec, _Run, PushTResult]):
    """Task: push a T-shaped block onto a T-shaped target with a round agent.

    Randomizations: where agent and block start (gym-pusht's own draw from the seed), the instruction.
    Success: the block covers more than 0.95 of the target. Reward: the covered share divided by 0.95, at
    most 1. Both are gym-pusht's, as are images, positions and info; without perturbations an episode is that
    of `gym_pusht/PushT-v0` of the same seed, bit for bit.

    Action: (2,) x and y in pixels of the board where the agent is to go, 0..512. Actions outside are
    executed, as by gym-pusht, up to a board's width away; also those that `dynamics` leads outside.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}  # noqa: RUF012

    def __init__(
        self,
        spec: PushTSpec = DEFAULT_PUSHT_SPEC,
        image_size: int = IMAGE_SIZE,
        results_path: str | None = None,
        render_mode: str | None = "rgb_array",
        policy: PolicyIdentity | None = None,
    ):
        check_image_size(image_size)
        super().__init__(spec, "pusht", results_path, render_mode)
        self._max_episode_steps = spec.max_steps
        self._policy = policy
        self._board = Board(image_size)
        self.action_space = self._board.action_space
        low_px, high_px = REACH_PX
        pixels = cast("spaces.Dict", self._board.observation_space)["pixels"]
        agent_pos = spaces.Box(low_px, high_px, (2,), np.float64)
        self.observation_space = spaces.Dict({"pixels": pixels, "agent_pos": agent_pos})
        self._coverage = self._max_coverage = 0.0

    def _begin(self, spec: PushTSpec) -> tuple[Observation, dict[str, Any]]:
        episode = sample_pusht_episode(spec)
        observation, info = self._board.begin(spec.seed, tuple(episode.perturbation.transforms.values()))
        dynamics = episode.perturbation.of(PushTDynamics)
        agent_xy = np.array(self._board.agent.position)
        actuator = None if dynamics is None else PushTActuator(agent_xy, dynamics, spec.seed)
        self._current_run = _Run(episode, self._board.block_pose, actuator)
        self.task_description = episode.instruction
        self._coverage = self._max_coverage = 0.0
        return self._sensed(observation), info | {"failure": "", "seed": spec.seed}

    def _check(self, action: np.ndarray) -> np.ndarray:
        return np.clip(super()._check(action), *REACH_PX)

    def _advance(self, run: _Run, action: np.ndarray) -> Transition:
        command = np.clip(run.actuator.command(action), *REACH_PX) if run.actuator else action
        observation, reward, terminated, _, info = self._board.step(command)
        self._coverage = float(info["coverage"])
        self._max_coverage = max(self._max_coverage, self._coverage)
        truncated = self._steps >= self._max_episode_steps
        info |= {
            "max_coverage": self._max_coverage,
            "failure": str(self._failure or "") if terminated or truncated else "",
            "seed": run.episode.spec.seed,
        }
        return self._sensed(observation), float(reward), bool(terminated), truncated, info

    def _draw_for_people(self, run: _Run) -> np.ndarray:
        """(384, 384, 3) uint8: the board and a cross where the last action led."""
        return run.episode.perturbation.sense(np.asarray(self._board.render()), self._steps)

    def _result(self, run: _Run) -> PushTResult:
        episode, failure = run.episode, self._failure
        x, y, angle_rad = self._board.goal_pose.tolist()
        return PushTResult(
            spec=episode.spec,
            instruction=episode.instruction,
            goal_pose=(x, y, angle_rad),
            steps=self._steps,
            is_success=failure is None,
            failure=failure,
            coverage=self._coverage,
            max_coverage=self._max_coverage,
            levels=dict(episode.perturbation.levels),
            image_size=self._board.observation_width,
            policy=self._policy,
        )

    def target_outline(self) -> np.ndarray:
        """(8, 2) pixels of the board, the corners of the target, in order."""
        return self._board.target_outline

    def close(self) -> None:
        """Free gym-pusht's resources."""
        self._board.close()

    @property
    def _failure(self) -> PushTFailure | None:
        """Reason why the episode failed, were it to end now."""
        board = self._board
        if self._coverage > board.success_threshold:
            return None
        start = self._run.block_pose
        return pusht_failure_of(start, board.block_pose, board.goal_pose, self._coverage, board.touched)

    def _sensed(self, observation: Any) -> dict[str, Any]:
        """Return gym-pusht's observation with its image as the camera's sensor takes it in this step."""
        pixels = self._run.episode.perturbation.sense(observation["pixels"], self._steps)
        return observation | {"pixels": pixels}
