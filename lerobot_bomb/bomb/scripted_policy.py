"""Base of policies that are programs, not networks: BOMB's floor and ceiling."""

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar, NoReturn

import numpy as np
import torch
from lerobot.configs import FeatureType, NormalizationMode, PreTrainedConfig
from lerobot.optim import LRSchedulerConfig, OptimizerConfig
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import OBS_ENV_STATE
from torch import Tensor

from lerobot_bomb.bomb.observation import ACTION_NAMES
from lerobot_bomb.bomb.privileged_state import PrivilegedState
from lerobot_bomb.compat.use import use


@dataclass
class ScriptedConfig(PreTrainedConfig):
    """Config of a policy without weights."""

    # whether it reads the simulator's true state, which environments then add to observations
    reads_true_state: ClassVar[bool] = True
    # {env type in which it acts: numbers that an action can have there}
    env_types: ClassVar[dict[str, set[int]]] = {"bomb": {len(names) for names in ACTION_NAMES.values()}}

    # publish the policy on the Hub
    push_to_hub: bool = False

    def __post_init__(self) -> None:
        use()
        self.device = self.device or "cpu"
        super().__post_init__()

    @property
    def normalization_mapping(self) -> dict[str, NormalizationMode]:
        return dict.fromkeys((feature.value for feature in FeatureType), NormalizationMode.IDENTITY)

    @property
    def observation_delta_indices(self) -> None:
        return None

    @property
    def action_delta_indices(self) -> None:
        return None

    @property
    def reward_delta_indices(self) -> None:
        return None

    def get_optimizer_preset(self) -> OptimizerConfig:
        self.refuse_training()

    def get_scheduler_preset(self) -> LRSchedulerConfig | None:
        self.refuse_training()

    def validate_features(self) -> None:
        shape = None if self.action_feature is None else self.action_feature.shape
        dims = set.union(*self.env_types.values())
        if shape not in {(dim,) for dim in dims}:
            raise ValueError(
                f"--policy.type={self.type} acts in --env.type={' and '.join(self.env_types)} only, where an "
                f"action has {' or '.join(map(str, sorted(dims)))} numbers; here the outputs are "
                f"{self.output_features}"
            )

    def refuse_training(self) -> NoReturn:
        """Raise a ValueError: there is nothing to train."""
        raise ValueError(
            f"--policy.type={self.type} is scripted and has nothing to train; evaluate it with lerobot-eval"
        )


class ScriptedPolicy(PreTrainedPolicy):
    """Base of the scripted policies: one action per call from the simulator's true state, no weights.

    The state also tells how the environment reads actions, so no flag can contradict the environment's.
    """

    config_class = ScriptedConfig  # pyright: ignore[reportAssignmentType]  LeRobot annotates it as None
    name = "scripted"  # pyright: ignore[reportAssignmentType]
    config: ScriptedConfig

    def __init__(self, config: ScriptedConfig, **_: object) -> None:
        super().__init__(config)
        config.validate_features()
        self.reset()

    @abstractmethod
    def act(self, state: PrivilegedState, step: int) -> np.ndarray:
        """(D,) action in the environment's units, in the step-th step of an episode."""

    def select_action(self, batch: dict[str, Tensor], **_: object) -> Tensor:
        """Observation ``environment_state`` (B, PrivilegedState.dim(G)) -> (B, D) actions in env units."""
        if OBS_ENV_STATE not in batch:
            raise ValueError(
                f"--policy.type={self.name} needs the observation {OBS_ENV_STATE!r}, the true state that "
                f"--env.type={' and '.join(self.config.env_types)} give; got {sorted(batch)}"
            )
        actions = np.stack([self._act(vector) for vector in batch[OBS_ENV_STATE].cpu().numpy()])
        self._step += 1
        return torch.from_numpy(actions.astype(np.float32))

    def _act(self, vector: np.ndarray) -> np.ndarray:
        return self.act(PrivilegedState.from_vector(vector), self._step)

    def predict_action_chunk(self, batch: dict[str, Tensor], **_: object) -> Tensor:
        """(B, 1, D): a chunk of one step."""
        return self.select_action(batch).unsqueeze(1)

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict | None]:
        self.config.refuse_training()

    def get_optim_params(self) -> dict:
        self.config.refuse_training()

    def reset(self) -> None:
        """Start a new episode: count steps from zero."""
        self._step = 0
