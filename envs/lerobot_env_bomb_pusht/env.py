"""PushT with BOMB's perturbation axes, as a Gymnasium environment."""

from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded

from lerobot_bomb.envs.pusht_results import PushTResult
from lerobot_bomb.envs.results import PolicyIdentity, write_result
from lerobot_bomb.pusht.episode import IMAGE_SIZE, PushTFailure, PushTSpec, check_image_size, failure_of
from lerobot_env_bomb_pusht.actuator import PushTActuator
from lerobot_env_bomb_pusht.axes.dynamics import PushTDynamics
from lerobot_env_bomb_pusht.board import Board
from lerobot_env_bomb_pusht.episode import PushTEpisode, sample_pusht_episode

DEFAULT_PUSHT_SPEC = PushTSpec(seed=0)


@dataclass(frozen=True)
class _Start:
    """What exists once an episode has been started."""

    episode: PushTEpisode
    block_pose: np.ndarray  # (3,)
    actuator: PushTActuator | None  # None: actions are executed as they are


class BombPushTEnv(gymnasium.Env[dict[str, Any], np.ndarray]):
    """Task: push a T-shaped block onto a T-shaped target with a round agent.

    Randomizations: where agent and block start (gym-pusht's own draw from the seed), the instruction.
    Success: the block covers more than 0.95 of the target. Reward: the covered share divided by 0.95, at
    most 1. Both are gym-pusht's, as are images, positions and info; without perturbations an episode is that
    of `gym_pusht/PushT-v0` of the same seed, bit for bit.

    Action: (2,) x and y in pixels of the board where the agent is to go, 0..512; it is not clipped.
    Once an episode has ended, `step` changes nothing until `reset`, and its reward is 0.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        spec: PushTSpec = DEFAULT_PUSHT_SPEC,
        image_size: int = IMAGE_SIZE,
        results_path: str | None = None,
        render_mode: str | None = "rgb_array",
        policy: PolicyIdentity | None = None,
    ):
        check_image_size(image_size)
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode={render_mode!r} is unknown; choose rgb_array or None")
        self.render_mode = render_mode
        self.task = "pusht"
        self.task_description = ""
        self._max_episode_steps = spec.max_steps
        self._spec, self._policy, self._results_path = spec, policy, results_path
        self._board = Board(image_size)
        self.action_space = self._board.action_space
        self.observation_space = self._board.observation_space
        self._current: _Start | None = None
        self._steps = 0
        self._coverage = self._max_coverage = 0.0
        self._last_transition: tuple | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode: of `seed`, else of the spec's seed at first, else of a fresh one.

        `options` has no effect; vector environments pass theirs on.
        """
        if seed is None and self._current is None:
            seed = self._spec.seed
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(2**31))
        episode = sample_pusht_episode(replace(self._spec, seed=int(seed)))
        observation, info = self._board.begin(int(seed), tuple(episode.perturbation.transforms.values()))
        dynamics = episode.perturbation.of(PushTDynamics)
        agent_xy = np.array(self._board.agent.position)
        actuator = None if dynamics is None else PushTActuator(agent_xy, dynamics, int(seed))
        self._current = _Start(episode, self._board.block_pose, actuator)
        self.task_description = episode.instruction
        self._steps, self._coverage, self._max_coverage = 0, 0.0, 0.0
        self._last_transition = None
        return self._sensed(observation), info | {"failure": "", "seed": int(seed)}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Run one control step."""
        start = self._start
        action = np.asarray(action)
        if action.shape != (2,) or not np.isfinite(action).all():
            raise ValueError(f"action {action.tolist()} must be two finite numbers, x and y in 0..512")
        if self._last_transition is not None:
            return deepcopy(self._last_transition)
        observation, reward, terminated, _, info = self._board.step(
            start.actuator.command(action) if start.actuator else action
        )
        self._steps += 1
        self._coverage = float(info["coverage"])
        self._max_coverage = max(self._max_coverage, self._coverage)
        truncated = self._steps >= self._max_episode_steps
        info |= {
            "max_coverage": self._max_coverage,
            "failure": str(self._failure or "") if terminated or truncated else "",
            "seed": start.episode.spec.seed,
        }
        transition = (self._sensed(observation), float(reward), bool(terminated), truncated, info)
        if terminated or truncated:
            self._last_transition = deepcopy((transition[0], 0.0, *transition[2:]))
            if self._results_path is not None:
                write_result(self._results_path, self.episode_result(), start.episode.spec.seed)
        return transition

    def render(self) -> np.ndarray | None:
        """(384, 384, 3) uint8 image for people: the board and a cross where the last action led.

        None, and a warning, in an environment that was made with render_mode=None.
        """
        start = self._start
        if self.render_mode is None:
            gymnasium.logger.warn("render() draws nothing: make the environment with render_mode='rgb_array'")
            return None
        return start.episode.perturbation.sense(np.asarray(self._board.render()), self._steps)

    def episode_result(self) -> PushTResult:
        """What became of the episode that has just ended."""
        if self._last_transition is None:
            raise ResetNeeded("the episode has not ended yet")
        episode, failure = self._start.episode, self._failure
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

    def close(self) -> None:
        """Free what gym-pusht holds."""
        self._board.close()

    @property
    def _start(self) -> _Start:
        if self._current is None:
            raise ResetNeeded("call reset before anything else")
        return self._current

    @property
    def _failure(self) -> PushTFailure | None:
        """Why the episode failed, were it to end now."""
        board = self._board
        if self._coverage > board.success_threshold:
            return None
        start = self._start.block_pose
        return failure_of(start, board.block_pose, board.goal_pose, self._coverage, board.touched)

    def _sensed(self, observation: Any) -> dict[str, Any]:
        """gym-pusht's observation with its image as the camera's sensor takes it in this step."""
        pixels = self._start.episode.perturbation.sense(observation["pixels"], self._steps)
        return observation | {"pixels": pixels}
