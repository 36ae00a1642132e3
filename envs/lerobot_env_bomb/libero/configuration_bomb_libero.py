"""LeRobot's env type ``bomb_libero``."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig, env_to_policy_features
from lerobot.envs.configs import LiberoEnv
from lerobot.utils.constants import LIBERO_KEY_PIXELS_AGENTVIEW, OBS_IMAGES, OBS_STATE

from lerobot_bomb.checkpoints.acting import acting_config
from lerobot_bomb.checkpoints.env_config import EvaluatedEnv
from lerobot_bomb.checkpoints.interface import Interface
from lerobot_bomb.checkpoints.libero_orientation import OrientationCheck
from lerobot_bomb.conditions import AxisCondition
from lerobot_bomb.flags import one_of
from lerobot_bomb.libero.assets import SUITES, prepare_libero
from lerobot_bomb.libero.episode import LIBERO_FPS, RENDER_PRESETS, STATE_DIM, TASKS_PER_SUITE, LiberoSpec
from lerobot_bomb.libero.goals import check_goals
from lerobot_bomb.libero.perturbations import LiberoCondition

CONTROL_MODES = ("relative", "absolute")


@EnvConfig.register_subclass("bomb_libero")
@dataclass
class BombLiberoEnvConfig(EvaluatedEnv, LiberoEnv):
    """Flags of ``--env.type=bomb_libero``: LeRobot's of `libero`, conditions and a file of results."""

    # a suite, or several: libero_spatial,libero_goal
    task: str = SUITES[0]
    # stock: LIBERO's images; fast: without multisampling, reflections and shadows, in a third of the time
    render_preset: str = RENDER_PRESETS[0]

    def _check(self) -> None:
        if not self.init_states:
            raise ValueError("--env.init_states=false: episodes start in the task's recorded states; drop it")
        if self.is_libero_plus:
            raise ValueError("--env.is_libero_plus=true: its perturbations are other ones; drop it")
        one_of("--env.control_mode", self.control_mode, CONTROL_MODES)
        one_of("--env.render_preset", self.render_preset, RENDER_PRESETS)
        for specs in self.groups.values():
            for spec in specs.values():
                self._check_control(spec.condition)

    def _check_control(self, condition: AxisCondition) -> None:
        """Raise a ValueError for noise and latency of poses, which `dynamics` defines for motions."""
        if self.control_mode == "absolute" and any(axis == "dynamics" for axis, *_ in condition.ranges):
            raise ValueError(
                f"--env.perturbations={condition} with --env.control_mode=absolute: noise and latency of "
                "dynamics are of relative motions; name the other axes alone, or set "
                "--env.control_mode=relative"
            )

    def _declare_features(self) -> None:
        LiberoEnv.__post_init__(self)

    @property
    def suites(self) -> list[str]:
        """Names of the suites."""
        return [name.strip() for name in str(self.task).split(",")]

    @property
    def groups(self) -> dict[str, dict[int, LiberoSpec]]:
        """{suite and condition: {number of a task: its spec}}."""
        return {
            key: {
                task_id: LiberoSpec(0, suite, task_id, self.episode_length, condition)
                for task_id in self._task_ids(suite)
            }
            for suite in self.suites
            for key, condition in LiberoCondition.groups(self.perturbations, suite).items()
        }

    def _check_policy(self) -> None:
        if self._is_guided:
            self._check_guide()
        state = PolicyFeature(type=FeatureType.STATE, shape=(STATE_DIM,))
        Interface(
            str(self.type),
            env_to_policy_features(self) | {OBS_STATE: state},
            (-1, 1) if self.control_mode == "relative" else None,
            "relative motions",
            lambda height, width: f"--env.observation_height={height} --env.observation_width={width}",
        ).check_acting_policy()

    @property
    def _is_guided(self) -> bool:
        """True if the policy that acts reads the simulator's true state."""
        return getattr(acting_config(), "reads_true_state", False)

    def _check_guide(self) -> None:
        """Raise a ValueError for what the scripted expert cannot do."""
        for name, value, allowed in (
            ("control_mode", self.control_mode, "relative"),
            ("fps", self.fps, LIBERO_FPS),
        ):
            if value != allowed:
                raise ValueError(f"--env.{name}={value}: the expert acts with --env.{name}={allowed} only")
        check_goals({spec for specs in self.groups.values() for spec in specs.values()})

    def _known_late(self, num_envs: int) -> list[dict[str, Any]]:
        late = super()._known_late(num_envs)
        # who reads the true state does not look at images
        return [{**each, "is_guided": True, "draws": False} for each in late] if self._is_guided else late

    def _import_env(self) -> type:
        prepare_libero(self.suites)
        from lerobot_env_bomb.libero.env import BombLiberoEnv  # imports the simulator

        return BombLiberoEnv

    def _on_first_reset(self) -> Callable[[LiberoSpec], Callable[[Any], None] | None]:
        check = None if self.ignore_checkpoint else OrientationCheck(self._scene_images)
        return lambda spec: check and partial(self._compare_images, check, spec)

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of `BombLiberoEnv` beside the spec."""
        scene = {
            "camera_name": self.camera_name,
            "camera_name_mapping": self.camera_name_mapping,
            "control_mode": self.control_mode,
            "control_freq": self.fps,
            "obs_type": self.obs_type,
            "render_preset": self.render_preset,
            "observation_height": self.observation_height,
            "observation_width": self.observation_width,
        }
        return {"scene": scene, "results_path": self.results_path, "render_mode": self.render_mode}

    @property
    def _scene_images(self) -> str:
        """The feature that holds images of the scene's camera."""
        return self.features_map[LIBERO_KEY_PIXELS_AGENTVIEW]

    def _compare_images(
        self, check: OrientationCheck, spec: LiberoSpec, observations: dict[str, Any]
    ) -> None:
        from libero.libero import benchmark  # slow

        images = observations["pixels"].get(self._scene_images.removeprefix(f"{OBS_IMAGES}."))
        if images is not None:
            images = images[:, ::-1, ::-1]  # as LiberoProcessorStep gives them to a policy
            suite = benchmark.get_benchmark_dict()[spec.suite]()
            check.compare(images, suite.get_task(spec.task_id).language)

    def _task_ids(self, suite: str) -> list[int]:
        one_of("--env.task", suite, SUITES)
        if self.task_ids is None:
            return list(range(TASKS_PER_SUITE[suite]))
        if not self.task_ids:
            raise ValueError("--env.task_ids=[] names no task; leave it out for all")
        return sorted(set(self.task_ids))
