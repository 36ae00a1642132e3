"""LeRobot's env type ``bomb_libero``."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig, env_to_policy_features
from lerobot.envs.configs import LiberoEnv
from lerobot.processor import PolicyProcessorPipeline
from lerobot.utils.constants import LIBERO_KEY_PIXELS_AGENTVIEW, OBS_IMAGES, OBS_STATE

from lerobot_bomb.checkpoints.identity import policy_of_results
from lerobot_bomb.checkpoints.interface import Interface
from lerobot_bomb.checkpoints.libero_orientation import OrientationCheck
from lerobot_bomb.checkpoints.queries import last_query
from lerobot_bomb.compat.use import use
from lerobot_bomb.envs.vector import LazyVectorEnv, check_parallel_tasks
from lerobot_bomb.flag_errors import flag_errors
from lerobot_bomb.flags import one_of
from lerobot_bomb.libero.assets import SUITES, prepare_libero
from lerobot_bomb.libero.episode import STATE_DIM, TASKS_PER_SUITE, LiberoSpec
from lerobot_bomb.libero.perturbations import LiberoCondition
from lerobot_bomb.results.writing import check_results_path

CONTROL_MODES = ("relative", "absolute")


@EnvConfig.register_subclass("bomb_libero")
@dataclass
class BombLiberoEnvConfig(LiberoEnv):
    """Flags of ``--env.type=bomb_libero``: LeRobot's of `libero`, conditions and a file of results."""

    # a suite, or several: libero_spatial,libero_goal
    task: str = SUITES[0]
    # conditions, each evaluated as a group of its own: ["none","table:3","table:2+light:3","all:1-5"]
    perturbations: list[str] | str | None = None
    # file that gets one JSON line per finished episode: seed, success, failure class
    results_path: str | None = None
    # run a checkpoint that was trained for another environment
    ignore_checkpoint: bool = False

    def __post_init__(self) -> None:
        use()
        with flag_errors():
            # an invalid flag raises here, before anything is built
            check_parallel_tasks(self.max_parallel_tasks)
            if not self.init_states:
                raise ValueError(
                    "--env.init_states=false: episodes start in the task's recorded states; drop it"
                )
            if self.is_libero_plus:
                raise ValueError("--env.is_libero_plus=true: its perturbations are other ones; drop it")
            one_of("--env.control_mode", self.control_mode, CONTROL_MODES)
            for suite in self.suites:
                for task_id in self._task_ids(suite):
                    for condition in self._conditions(suite).values():
                        self._spec(suite, task_id, condition)
        if self.results_path is not None:
            self.results_path = str(Path(self.results_path).expanduser())
        super().__post_init__()

    @property
    def suites(self) -> list[str]:
        """Names of the suites."""
        return [name.strip() for name in str(self.task).split(",")]

    def get_env_processors(self) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
        """Return LeRobot's processors, after a check of the policy that acts.

        Every command asks for them once, when its policy is built and no episode has begun.

        Raises:
            ValueError: that policy was trained for another environment.
        """
        if not self.ignore_checkpoint:
            state = PolicyFeature(type=FeatureType.STATE, shape=(STATE_DIM,))
            Interface(
                str(self.type),
                env_to_policy_features(self) | {OBS_STATE: state},
                (-1, 1) if self.control_mode == "relative" else None,
                "relative motions",
                lambda height, width: f"--env.observation_height={height} --env.observation_width={width}",
            ).check_acting_policy()
        return super().get_env_processors()

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, LazyVectorEnv]]:
        """{suite and condition: {task: vector env of n_envs}}; no worker starts before a first reset.

        Raises:
            ValueError: LIBERO or its assets are not there, or --env.results_path cannot be written.
        """
        prepare_libero(self.suites)
        from lerobot_env_bomb_libero.env import BombLiberoEnv  # imports the simulator

        check_results_path(self.results_path)
        check = None if self.ignore_checkpoint else OrientationCheck(self._scene_images)
        return {
            key: {
                task_id: LazyVectorEnv(
                    [partial(BombLiberoEnv, self._spec(suite, task_id, condition), **self.gym_kwargs)]
                    * n_envs,
                    use_async=use_async_envs and n_envs > 1,
                    known_late=partial(policy_of_results, self.results_path),
                    last_query=last_query,
                    on_first_reset=check and partial(self._compare_images, check, suite, task_id),
                )
                for task_id in self._task_ids(suite)
            }
            for suite in self.suites
            for key, condition in self._conditions(suite).items()
        }

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of `BombLiberoEnv` beside the spec."""
        scene = {
            "camera_name": self.camera_name,
            "camera_name_mapping": self.camera_name_mapping,
            "control_mode": self.control_mode,
            "control_freq": self.fps,
            "obs_type": self.obs_type,
            "observation_height": self.observation_height,
            "observation_width": self.observation_width,
        }
        return {"scene": scene, "results_path": self.results_path, "render_mode": self.render_mode}

    @property
    def _scene_images(self) -> str:
        """The feature that holds images of the scene's camera."""
        return self.features_map[LIBERO_KEY_PIXELS_AGENTVIEW]

    def _compare_images(
        self, check: OrientationCheck, suite: str, task_id: int, observations: dict[str, Any]
    ) -> None:
        from libero.libero import benchmark  # slow

        images = observations["pixels"].get(self._scene_images.removeprefix(f"{OBS_IMAGES}."))
        if images is not None:
            images = images[:, ::-1, ::-1]  # as LiberoProcessorStep gives them to a policy
            check.compare(images, benchmark.get_benchmark_dict()[suite]().get_task(task_id).language)

    def _task_ids(self, suite: str) -> list[int]:
        one_of("--env.task", suite, SUITES)
        if self.task_ids is None:
            return list(range(TASKS_PER_SUITE[suite]))
        if not self.task_ids:
            raise ValueError("--env.task_ids=[] names no task; leave it out for all")
        return sorted(set(self.task_ids))

    def _conditions(self, suite: str) -> dict[str, str]:
        """{key of a group of results: its condition}; the suite alone where no condition is named."""
        return LiberoCondition.groups(self.perturbations, suite)

    def _spec(self, suite: str, task_id: int, condition: str) -> LiberoSpec:
        return LiberoSpec(0, suite, task_id, self.episode_length, condition)
