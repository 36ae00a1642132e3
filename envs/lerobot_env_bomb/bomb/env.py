"""BOMB as a Gymnasium environment."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lerobot_bomb.bomb import so101
from lerobot_bomb.bomb.board import Intersection
from lerobot_bomb.bomb.camera import PinholeCamera
from lerobot_bomb.bomb.episode import DEFAULT_FPS, PHYSICS_HZ, EpisodeSpec
from lerobot_bomb.bomb.judge import Judge
from lerobot_bomb.bomb.layout import SceneState
from lerobot_bomb.bomb.observation import (
    AGENT_POS,
    CAMERAS,
    ENVIRONMENT_STATE,
    PIXELS,
    RenderOptions,
)
from lerobot_bomb.bomb.privileged_state import PrivilegedState
from lerobot_bomb.bomb.streams import Stream, generator
from lerobot_bomb.bomb.suite import find_suite
from lerobot_bomb.envs.episode_env import EpisodeEnv, Observation, Transition
from lerobot_bomb.results.bomb import EpisodeResult
from lerobot_bomb.results.origin import PolicyIdentity, sapien_version
from lerobot_env_bomb.bomb.actuator import Actuator
from lerobot_env_bomb.bomb.alternatives import alternatives
from lerobot_env_bomb.bomb.arm_files import check_robot
from lerobot_env_bomb.bomb.axes.dynamics import Dynamics
from lerobot_env_bomb.bomb.object_masks import object_masks
from lerobot_env_bomb.bomb.perturb import PerturbedEpisode, sample_episode
from lerobot_env_bomb.bomb.render import Renderer, compose_caption, extrinsics, intrinsics, renderer_of
from lerobot_env_bomb.bomb.scene import Scene
from lerobot_env_bomb.bomb.simulators import check_simulator
from lerobot_env_bomb.bomb.spaces import action_space, observation_space
from lerobot_env_bomb.bomb.static_scene import StaticScene, draw_static, starting_scene

DEFAULT_SPEC = EpisodeSpec(seed=0)
DEFAULT_RENDER_OPTIONS = RenderOptions()
PERSON_IMAGE_SIZE = 384  # pixels, either half of render()'s image


@dataclass(frozen=True)
class _Run:
    """State of an episode that has been started."""

    scene: Scene
    episode: PerturbedEpisode
    judge: Judge
    actuator: Actuator


class BombEnv(EpisodeEnv[EpisodeSpec, _Run, EpisodeResult]):
    """Task: place a Go stone on the intersection that an instruction names; other suites have other tasks.

    Randomizations of suite `place`: target (always free and legal), colour, instruction, 0-8 stones on the
    board, gripper and stone at the start.
    Success: see `Judge`. Reward is 1 on the step that ends in success, else 0.

    Action: float32 (4,). Relative: x, y, z in units of MAX_STEP_M per control step from where the
    gripper is; absolute: x, y, z in metres. The fourth opens the fingers at >= 0 and closes them below.
    Joints, float32 (6,): of SO-101, in degrees, the jaw's in percent, as the real arm's driver has them.
    An action outside the action space is clipped.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": DEFAULT_FPS}  # noqa: RUF012

    def __init__(
        self,
        spec: EpisodeSpec = DEFAULT_SPEC,
        render_options: RenderOptions = DEFAULT_RENDER_OPTIONS,
        results_path: str | None = None,
        render_mode: str | None = "rgb_array",
        task_ids: tuple[int, ...] | None = None,
        policy: PolicyIdentity | None = None,
    ):
        suite = find_suite(spec.suite)
        suite.check(spec)
        check_robot(spec)
        check_simulator(spec.simulator, render_options.preset)
        super().__init__(spec, spec.suite, results_path, render_mode)
        self._num_substeps = PHYSICS_HZ // spec.fps
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": spec.fps}
        self._max_episode_steps = round(suite.max_steps * spec.fps / DEFAULT_FPS)
        self._render_options = render_options
        self._task_ids, self._policy = task_ids, policy
        self.action_space = action_space(spec.control_mode)
        self.gripper_dims = (len(self.action_space.low) - 1,)
        self._action_low, self._action_high = self.action_space.low, self.action_space.high
        self.observation_space = observation_space(render_options, suite.num_goals, spec.control_mode)
        self._now: SceneState  # measured after the last control step
        self._renderer: Renderer | None = None

    def _begin(self, spec: EpisodeSpec) -> tuple[Observation, dict[str, Any]]:
        episode = sample_episode(spec)
        self._set_up(episode, starting_scene(episode))
        return self._observe(), self._info()

    def show_static(self, seed: int) -> tuple[Observation, EpisodeResult]:
        """Draw a board of a seed's episode as in mid-episode; the episode cannot be run from there.

        The result names the episode, which has no outcome.
        """
        episode = sample_episode(replace(self._spec, seed=seed))
        self._steps = 0
        self._set_up(episode, draw_static(episode, generator(seed, Stream.STATIC)))
        return self._observe(), self._result(self._run)

    def _set_up(self, episode: PerturbedEpisode, start: StaticScene) -> None:
        run, spec = self._current_run, self._spec
        scene = Scene(spec.robot, spec.simulator) if run is None else run.scene
        scene.reset(start.layout, episode.perturbation.model_edits, episode.pattern)
        if start.held is not None:
            scene.hold(start.held, start.held_xyz, start.opening_m)
        self._now = now = scene.measure()
        dynamics = episode.perturbation.of(Dynamics)
        self._current_run = _Run(
            scene=scene,
            episode=episode,
            judge=Judge(episode, self._spec.fps, now, start.made),
            actuator=Actuator(
                self._spec.control_mode,
                now.gripper_xyz,
                start.layout.stone_radius_m,
                dynamics,
                episode.spec.seed,
            ),
        )
        self.task_description = episode.instruction_after(len(start.made))

    def _advance(self, run: _Run, action: np.ndarray) -> Transition:
        command = run.actuator.command(action, self._now.gripper_xyz)
        if self._spec.control_mode == "joints":
            run.scene.move_joints(so101.from_driver(command), self._num_substeps)
        else:
            run.scene.move(command[:3], bool(command[3] >= 0), self._num_substeps)
        self._now = run.scene.measure()
        terminated = run.judge.update(self._now)
        self.task_description = run.episode.instruction_after(run.judge.num_made)
        truncated = not terminated and self._steps >= self._max_episode_steps
        if truncated:
            run.judge.time_out()
        return self._observe(), float(run.judge.is_success), terminated, truncated, self._info()

    def _draw_for_people(self, run: _Run) -> np.ndarray:
        """Draw both cameras, the instruction, and how the episode stands."""
        images = [self._draw(camera, PERSON_IMAGE_SIZE) for camera in CAMERAS]
        episode = run.episode
        error_mm = run.judge.placement_error_mm
        outcome = f"failed: {run.judge.failure}" if run.judge.failure else f"stage: {run.judge.stage}"
        outcome = "success" if run.judge.is_success else outcome
        if episode.target is not None:
            row, column = episode.target
            aim = f"target row {row}, column {column}"
        else:
            aim = f"moves {run.judge.num_made} of {len(episode.plans[0])}"
        status = f"{aim}   error {error_mm:.0f} mm   {outcome}"
        return compose_caption(images, [self.task_description, status])

    def _result(self, run: _Run) -> EpisodeResult:
        episode, judge = run.episode, run.judge
        return EpisodeResult(
            spec=episode.spec,
            instruction=episode.instruction,
            task_id=episode.task_id,
            target=episode.target,
            color=episode.color,
            progress=judge.progress,
            steps=self._steps,
            is_success=judge.is_success,
            is_success_bomb_v0=judge.is_success_bomb_v0,
            failure=judge.failure,
            stage=judge.stage,
            placement_error_mm=judge.placement_error_mm,
            nearest_intersection=judge.nearest_intersection,
            collateral_mm=judge.collateral_mm,
            levels=dict(episode.perturbation.levels),
            image_size=self._render_options.image_size,
            render_preset=self._render_options.preset,
            task_ids=self._task_ids,
            policy=self._policy,
            opengl_vendor=None if self._renderer is None else self._renderer.opengl_vendor,
            opengl_renderer=None if self._renderer is None else self._renderer.opengl_renderer,
            task_version=find_suite(episode.spec.suite).version,
            sapien_version=sapien_version(episode.spec.simulator, self._render_options.preset),
        )

    def close(self) -> None:
        """Free what draws."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def privileged_state(self) -> PrivilegedState:
        """Return the simulator's true state."""
        run, now = self._run, self._now
        return PrivilegedState(
            gripper_xyz=now.gripper_xyz,
            finger_opening=now.finger_opening,
            goals=run.judge.goals(),
            stone_xyz=now.stone_xyz,
            stone_is_white=run.episode.layout.stone_is_white,
            stone_in_play=run.episode.layout.stone_in_play,
            stage=run.judge.stage,
            control_mode=self._spec.control_mode,
            fps=self._spec.fps,
            stone_radius_m=run.episode.layout.stone_radius_m,
            max_opening_m=2 * run.scene.robot.max_half_opening_m,
            pending_motion_m=run.actuator.pending_motion_m(now.gripper_xyz, now.finger_opening),
            pending_gripper=run.actuator.pending_gripper,
        )

    def object_masks(self) -> dict[str, dict[str, np.ndarray]]:
        """{camera: {object: (H, W) bool}}: the pixels of each object in the observation's images."""
        run, size = self._run, self._render_options.image_size
        goal, radius_m = run.judge.next_goal(), run.episode.layout.stone_radius_m
        return {
            camera: object_masks(
                run.scene, self._camera_renderer, camera, size, goal.stone, goal.xyz[:2], radius_m
            )
            for camera in CAMERAS
        }

    def cameras(self) -> dict[str, PinholeCamera]:
        """Return intrinsics and current pose of each camera of the observation's images."""
        scene, size = self._run.scene, self._render_options.image_size
        return {
            camera: PinholeCamera(intrinsics(scene.model, camera, size), extrinsics(scene.data, camera))
            for camera in CAMERAS
        }

    def alternatives(self) -> dict[str, tuple[str, Intersection]]:
        """Return other instructions for this episode, as `lerobot_env_bomb.bomb.alternatives` gives them."""
        return alternatives(self._run.episode)

    def _check(self, action: np.ndarray) -> np.ndarray:
        """Return an action as float64 within the action space."""
        return np.clip(super()._check(action).astype(np.float64), self._action_low, self._action_high)

    def _observe(self) -> Observation:
        state = self.privileged_state()
        views = {camera: self._view(camera) for camera in CAMERAS}
        return {
            PIXELS: {camera: image for camera, (image, _) in views.items()},
            AGENT_POS: self._agent_pos(state).astype(np.float32),
            ENVIRONMENT_STATE: state.to_vector(),
            **{key: value for _, geometry in views.values() for key, value in geometry.items()},
        }

    def _agent_pos(self, state: PrivilegedState) -> np.ndarray:
        if self._spec.control_mode == "joints":
            return so101.to_driver(self._run.scene.joints())
        return np.array([*state.gripper_xyz, state.finger_opening])

    def _view(self, camera: str) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """(H, W, 3) uint8 image; depth, intrinsics and extrinsics by key, if requested."""
        scene, size = self._run.scene, self._render_options.image_size
        if not self._render_options.depth:
            return self._draw(camera, size), {}
        image, depth_m = self._camera_renderer.draw_depth(scene.data, camera, size)
        return self._sense(image, camera), {
            f"depth.{camera}": depth_m,
            f"intrinsics.{camera}": intrinsics(scene.model, camera, size),
            f"extrinsics.{camera}": extrinsics(scene.data, camera),
        }

    def _draw(self, camera: str, size: int) -> np.ndarray:
        """(size, size, 3) uint8 image."""
        return self._sense(self._camera_renderer.draw(self._run.scene.data, camera, size), camera)

    def _sense(self, image: np.ndarray, camera: str) -> np.ndarray:
        """Return the image as the camera's sensor takes it in this step."""
        number = len(CAMERAS) * self._steps + CAMERAS.index(camera)
        return self._run.episode.perturbation.sense(image, number)

    @property
    def _camera_renderer(self) -> Renderer:
        if self._renderer is None:
            largest = max(self._render_options.image_size, PERSON_IMAGE_SIZE)
            self._renderer = renderer_of(self._run.scene.model, self._render_options, largest)
        return self._renderer

    def _info(self) -> dict[str, Any]:
        judge = self._run.judge
        row, column = judge.nearest_intersection
        return {
            "is_success": judge.is_success,
            "is_success_bomb_v0": judge.is_success_bomb_v0,
            "progress": judge.progress,
            "placement_error_mm": judge.placement_error_mm,
            "nearest_row": row,
            "nearest_column": column,
            "stage": str(judge.stage),
            "failure": str(judge.failure or ""),
            "collateral_mm": judge.collateral_mm,
            "seed": self._run.episode.spec.seed,
        }
