"""LeRobot's env type ``bomb``. The only module of this package that imports LeRobot."""

from dataclasses import dataclass, field, replace
from typing import Any, cast

from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.envs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_PREFIX, OBS_STATE

from lerobot_bomb.bomb.environment import Environment
from lerobot_bomb.bomb.episode import DEFAULT_FPS, EpisodeSpec
from lerobot_bomb.bomb.observation import (
    ACTION_NAMES,
    AGENT_POS,
    CAMERAS,
    DEFAULT_IMAGE_SIZE,
    RenderOptions,
    geometry_shapes,
    state_names,
)
from lerobot_bomb.bomb.perturbations import Condition
from lerobot_bomb.bomb.suite import find_suite, specs_of_tasks, suites_of, task_version
from lerobot_bomb.checkpoints.env_config import EvaluatedEnv
from lerobot_bomb.checkpoints.environment import check_acting_policy, side_of_images
from lerobot_bomb.conditions import ALL
from lerobot_env_bomb.bomb.arm_files import check_robot
from lerobot_env_bomb.bomb.simulators import check_simulator


@EnvConfig.register_subclass("bomb")
@dataclass
class BombEnvConfig(EvaluatedEnv, EnvConfig):
    """Flags of ``--env.type=bomb``; every check happens before an environment is built."""

    # suite: place, object, spatial, goal, long, or all
    task: str | None = "place"
    # numbered tasks of the suite, as [0,7,12]; of place 25 x colour + 5 x row + column with black = 0,
    # white = 1; unset draws one per episode
    task_ids: list[int] | None = None
    # control steps per second; a divisor of 200
    fps: int = DEFAULT_FPS
    # arm: scara, fetch (of gymnasium-robotics; needs MuJoCo 3) or so101 (extra so101)
    robot: str = "scara"
    # physics: mujoco, or sapien (PhysX; extra sapien)
    simulator: str = "mujoco"
    # relative: dx, dy, dz in units of 40 mm; absolute: x, y, z in metres; joints: those of so101 in degrees
    control_mode: str = "relative"
    # intersections, templates and table colours to draw from: all, train or heldout
    split: str = "all"
    # target [row, column]; unset draws one per episode
    target: list[int] | None = None
    # colour of the stone to be moved: black or white; unset draws one per episode
    color: str | None = None
    # width and height of each camera in pixels; unset: as the evaluated checkpoint was trained, else 256
    image_size: int | None = None
    # fast (no shadows), shadows, or sapien (SAPIEN's renderer; extra sapien, a Vulkan driver)
    render_preset: str = "fast"
    # also observe each camera's depth in metres, intrinsics and pose
    depth: bool = False
    # distance from the intersection within which a placement counts
    success_tolerance_mm: float = 10.0
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def _check(self) -> None:
        for spec in (spec for specs in self.groups.values() for spec in specs.values()):
            find_suite(spec.suite).check(spec)
            check_robot(spec)
            check_simulator(spec.simulator, self.render_preset)
        geometry_shapes(self.render_options)

    def take_image_size(self, config: PreTrainedConfig | None) -> None:
        """Show images of the size that a policy was trained on, unless a flag gives another."""
        if self.image_size is None and (side := side_of_images(config, CAMERAS)) is not None:
            self.image_size = side
            self._declare_features()

    def _declare_features(self) -> None:
        side = self.render_options.image_size
        image = PolicyFeature(type=FeatureType.VISUAL, shape=(side, side, 3))
        cameras = [f"{OBS_IMAGES}.{camera}" for camera in CAMERAS]
        self.features = {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(len(ACTION_NAMES[self.control_mode]),)),
            AGENT_POS: PolicyFeature(type=FeatureType.STATE, shape=(len(state_names(self.control_mode)),)),
            **dict.fromkeys(cameras, image),
        }
        self.features_map = {ACTION: ACTION, AGENT_POS: OBS_STATE, **{key: key for key in cameras}}
        for key, shape in geometry_shapes(self.render_options).items():
            self.features[key] = PolicyFeature(type=FeatureType.STATE, shape=shape)
            self.features_map[key] = f"{OBS_PREFIX}{key}"  # where LeRobot puts keys it does not know

    @property
    def groups(self) -> dict[str, dict[int, EpisodeSpec]]:
        """{suite and condition: {number of a task: its spec}}; {0: ...} where tasks are drawn per episode."""
        return {
            key: {
                task_id: replace(spec, perturbations=condition)
                for task_id, spec in zip(self.task_ids or [0], self.specs_of(suite), strict=True)
            }
            for suite in suites_of(str(self.task))
            for key, condition in Condition.groups(self.perturbations, suite).items()
        }

    def specs_of(self, suite: str) -> list[EpisodeSpec]:
        """Return the unperturbed spec of each numbered task; a single one if tasks are drawn per episode."""
        if self.task_ids == []:
            raise ValueError("--env.task_ids=[] selects no task; leave it out to draw one per episode")
        if self.task_ids and self.task == ALL:
            raise ValueError(
                f"--env.task_ids={self.task_ids} are numbers in a suite; --env.task={ALL} is of all"
            )
        spec = EpisodeSpec(
            seed=0,
            suite=suite,
            robot=self.robot,
            split=self.split,
            control_mode=self.control_mode,
            fps=self.fps,
            target=None if self.target is None else cast("tuple[int, int]", tuple(self.target)),
            color=self.color,
            success_tolerance_mm=self.success_tolerance_mm,
            simulator=self.simulator,
        )
        return specs_of_tasks(spec, self.task_ids or [])

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of `BombEnv` beside the spec."""
        return {
            "render_options": self.render_options,
            "results_path": self.results_path,
            "task_ids": None if self.task_ids is None else tuple(self.task_ids),
        }

    @property
    def render_options(self) -> RenderOptions:
        side = DEFAULT_IMAGE_SIZE if self.image_size is None else self.image_size
        return RenderOptions(image_size=side, preset=self.render_preset, depth=self.depth)

    @property
    def environment(self) -> Environment:
        """Environment that a policy must have been trained for to act here."""
        return Environment(
            robot=self.robot,
            control_mode=self.control_mode,
            fps=self.fps,
            image_size=self.render_options.image_size,
            cameras=CAMERAS,
            task_version=task_version(str(self.task)),
            task=str(self.task),
            depth=self.depth,
            task_ids=tuple(self.task_ids or ()),
        )

    def _check_policy(self) -> None:
        check_acting_policy(self.environment)

    def _import_env(self) -> type:
        from lerobot_env_bomb.bomb.env import BombEnv  # chooses an OpenGL backend, imports MuJoCo

        return BombEnv
