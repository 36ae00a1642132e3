"""Parameters of a recording, and the episodes that it tries."""

from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING

from lerobot_bomb import __version__
from lerobot_bomb.bomb.episode import DEFAULT_FPS, EpisodeSpec
from lerobot_bomb.bomb.observation import DEFAULT_IMAGE_SIZE, RenderOptions
from lerobot_bomb.bomb.suite import specs_of_tasks, suites_of, task_version
from lerobot_bomb.conditions import ALL, NONE
from lerobot_bomb.data.base_recording import BaseRecording
from lerobot_bomb.data.rollout_pool import RolloutSettings
from lerobot_bomb.envs.rollout import Expert
from lerobot_bomb.flags import rewording_errors
from lerobot_bomb.results.origin import installed_version, sapien_version

if TYPE_CHECKING:
    from lerobot_bomb.data.blocks import DatasetLayout

SCENES = 100  # static scenes that are stored as an episode


@dataclass(frozen=True)
class Recording(BaseRecording):
    """Parameters that determine a recording of BOMB frame by frame."""

    task: str = "place"
    robot: str = "scara"
    simulator: str = "mujoco"
    control_mode: str = "relative"
    fps: int = DEFAULT_FPS
    image_size: int = DEFAULT_IMAGE_SIZE
    split: str = "all"
    # (row, column) and colour; None = drawn per episode
    target: tuple[int, int] | None = None
    color: str | None = None
    # numbered tasks, each run from every seed; empty = target and colour as above
    task_ids: tuple[int, ...] = ()
    perturbations: tuple[str, ...] = (NONE,)  # conditions, each run from every seed, with every task
    images: bool = False
    render_preset: str = "fast"
    depth: bool = False
    success_tolerance_mm: float = EpisodeSpec.success_tolerance_mm
    noise: float = 0.0
    # scenes instead of episodes: boards as they may stand midway, a frame each, which belongs to no other
    static: int = 0
    # SHA-256 of the weights of the policy that acts, while the expert labels
    relabel: str | None = None
    # whether columns say what the expert points at, for training only
    pointing: bool = False
    # the suite's version, by the name that recordings of 1.0 have; filled in
    protocol_version: str = ""
    package_version: str = __version__
    # another one gives other bits
    mujoco_version: str | None = field(default_factory=partial(installed_version, "mujoco"))
    # None where it neither simulates nor draws; filled in
    sapien_version: str | None = None

    def __post_init__(self) -> None:
        if self.static:
            self._of_scenes()
        self._check(self.perturbations, self.noise)
        if self.task_ids and self.task == ALL:
            raise ValueError(
                f"--env.task_ids={list(self.task_ids)} are numbers in a suite; --env.task={ALL} is of all"
            )
        if self.pointing and self.control_mode == "joints":
            raise ValueError(
                "--env.control_mode=joints: --pointing and --static label actions of the gripper; choose "
                "relative or absolute"
            )
        object.__setattr__(self, "sapien_version", sapien_version(self.simulator, self.render_preset))
        if not self.protocol_version:
            object.__setattr__(self, "protocol_version", task_version(self.task))
        with self.flag_names():
            conditions, _ = self.conditions, self.render_options  # they check the remaining flags
        if len(set(conditions)) < len(conditions):
            raise ValueError(f"--env.perturbations={','.join(self.perturbations)} has a condition twice")

    def _of_scenes(self) -> None:
        """Set the number of episodes from that of scenes, which are always labelled."""
        if self.static < 1 or self.static % self.scenes:
            raise ValueError(f"--static={self.static} must be in 1..{SCENES} or a multiple of {SCENES}")
        if self.simulator != "mujoco":
            raise ValueError(
                f"--env.simulator={self.simulator}: nothing moves in static scenes; leave it out"
            )
        for name, value in {"--relabel": self.relabel, f"--noise={self.noise}": self.noise}.items():
            if value:
                raise ValueError(f"{name}: static scenes are no episodes; leave it out with --static")
        object.__setattr__(self, "episodes", self.static // self.scenes)
        object.__setattr__(self, "pointing", True)

    @property
    def scenes(self) -> int:
        """Number of scenes stored as one episode, as LeRobot takes long for each; 1 without scenes."""
        return min(self.static, SCENES) or 1

    @property
    def suite_specs(self) -> list[EpisodeSpec]:
        """Specs that all episodes of a suite share, with the first seed; one for each suite."""
        return [self._spec_of(suite) for suite in suites_of(self.task)]

    def _spec_of(self, suite: str) -> EpisodeSpec:
        return EpisodeSpec(
            seed=self.seed,
            suite=suite,
            robot=self.robot,
            simulator=self.simulator,
            split=self.split,
            control_mode=self.control_mode,
            fps=self.fps,
            target=self.target,
            color=self.color,
            success_tolerance_mm=self.success_tolerance_mm,
        )

    @property
    def conditions(self) -> list[EpisodeSpec]:
        """Return the specs that every seed is run with; they hold the first seed."""
        tasks = [task for spec in self.suite_specs for task in specs_of_tasks(spec, self.task_ids)]
        return [replace(task, perturbations=text) for task in tasks for text in self.perturbations]

    def rollouts(self, expert: Expert) -> RolloutSettings:
        scenes = self.scenes if self.static else 0
        return RolloutSettings(self.render_options, self.noise, expert, scenes, self.pointing)

    def layout(self) -> "DatasetLayout":
        from lerobot_bomb.data.rollout_dataset import rollout_layout  # LeRobot: seconds

        return rollout_layout(self)

    @property
    def render_options(self) -> RenderOptions:
        return RenderOptions(self.image_size, self.render_preset, self.depth)

    def flag_names(self) -> AbstractContextManager[None]:
        """Name flags in errors as they were given: a target by --env.target, or by the number of a task."""
        return rewording_errors({"--env.target=": "the target "} if self.task_ids else {})
