"""Base of our env types' configs: the flags, checks and vector environments they share."""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import draccus
from draccus.utils import DecodingError
from lerobot.envs import EnvConfig
from lerobot.processor import PolicyProcessorPipeline
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_bomb.checkpoints.identity import policy_of_results
from lerobot_bomb.checkpoints.queries import last_query
from lerobot_bomb.compat.hooks.evaluation import note_training_steps, tell_of_evaluations
from lerobot_bomb.compat.use import use
from lerobot_bomb.envs.vector import LazyVectorEnv, check_parallel_tasks
from lerobot_bomb.flag_errors import flag_errors
from lerobot_bomb.flags import one_of
from lerobot_bomb.results.record import Spec
from lerobot_bomb.results.writing import check_results_path


def decode_env(flags: Mapping[str, Any]) -> EnvConfig:
    """Return the config of an environment, given its flags by name: {"type": "bomb", "task": "goal"}.

    Raises:
        ValueError: the type or a flag is unknown, or has a value that is not allowed.
    """
    register_third_party_plugins()
    one_of("--env.type", flags["type"], sorted(EnvConfig.get_known_choices()))
    try:
        return draccus.decode(EnvConfig, dict(flags))
    except DecodingError as error:
        raise ValueError(str(error)) from None


_EnvConfig = EnvConfig if TYPE_CHECKING else object  # the defaults of a subclass' other base hold


@dataclass
class EvaluatedEnv(_EnvConfig):
    """An env type with conditions and records; it stands before LeRobot's config among the bases."""

    # conditions, each evaluated as a group of its own: ["none","table:3","table:2+object:3","all:1-5"]
    perturbations: list[str] | str | None = None
    # file that gets one JSON line per finished episode: seed, success, failure class
    results_path: str | None = None
    # let a checkpoint act that was trained for another environment
    ignore_checkpoint: bool = False

    def __post_init__(self) -> None:
        use()
        note_training_steps()
        with flag_errors():
            check_parallel_tasks(self.max_parallel_tasks)
            self._check()
        if self.results_path is not None:
            self.results_path = str(Path(self.results_path).expanduser())
        self._declare_features()

    @property
    @abstractmethod
    def groups(self) -> Mapping[str, Mapping[int, Spec]]:
        """{key of a group of results, as "place.camera-3": {number of a task: its spec}}."""

    @abstractmethod
    def _check(self) -> None:
        """Raise a ValueError for a flag that is not allowed, before anything is built."""

    @abstractmethod
    def _declare_features(self) -> None:
        """Declare the observations that a policy gets here, and the actions that it returns."""

    @abstractmethod
    def _check_policy(self) -> None:
        """Raise a ValueError if the policy that acts was trained for another environment."""

    @abstractmethod
    def _import_env(self) -> type:
        """Import the simulator; return the class of environments, which takes `gym_kwargs` and a spec."""

    def _on_first_reset(self) -> Callable[[Any], Callable[[Any], None] | None]:
        """Return a function that maps a spec to the one to call with its first observations, or to None."""
        return lambda spec: None

    def _known_late(self, num_envs: int) -> list[dict[str, Any]]:
        """Return for each environment its arguments that are known once the policy is built."""
        return policy_of_results(self.results_path, num_envs)

    def get_env_processors(self) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
        """Return LeRobot's processors, after a check of the policy that acts.

        Every command asks for them once, when its policy is built and no episode has begun.
        """
        if not self.ignore_checkpoint:
            self._check_policy()
        return super().get_env_processors()

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, LazyVectorEnv]]:
        """{key of a group: {number of a task: vector env of n_envs}}; no worker starts before a first reset.

        Raises:
            NoOpenGLError: MuJoCo cannot render on this machine.
            ValueError: the simulator is not installed, or --env.results_path cannot be written.
        """
        make_env, on_first_reset = self._import_env(), self._on_first_reset()
        check_results_path(self.results_path)
        tell_of_evaluations()
        kwargs, groups = self.gym_kwargs, self.groups
        return {
            key: {
                task_id: LazyVectorEnv(
                    [partial(make_env, **(kwargs | {"spec": spec}))] * n_envs,
                    use_async=use_async_envs and n_envs > 1,
                    known_late=self._known_late,
                    last_query=last_query,
                    on_first_reset=on_first_reset(spec),
                    num_tasks=sum(map(len, groups.values())),
                    results_path=self.results_path,
                )
                for task_id, spec in specs.items()
            }
            for key, specs in groups.items()
        }
