"""A checkpoint of LeRobot as a model server of vla-eval, loaded and called as lerobot-eval does it."""

import json
from typing import Any

from vla_eval.model_servers.base import SessionContext
from vla_eval.model_servers.predict import PredictModelServer
from vla_eval.specs import IMAGE_RGB, LANGUAGE, RAW, DimSpec
from vla_eval.types import Action, Observation

from lerobot_bomb.bomb.environment import Environment
from lerobot_bomb.bomb.episode import TEST_SEEDS
from lerobot_bomb.checkpoints.acting import acting
from lerobot_bomb.checkpoints.environment import check_acting_policy
from lerobot_bomb.checkpoints.standalone import StandalonePolicy
from lerobot_bomb.harness.benchmark import ENVIRONMENT


class CheckpointServer(PredictModelServer):
    """Runs one episode at a time, an action per observation.

    A policy keeps the state of one episode (queue of actions, ensemble, past observations, noise). So another
    session's observations are refused until the episode has ended: each shard needs its own server. An
    observation has ``images`` {camera: (H, W, 3) uint8}, ``states`` or ``state`` (S,) and
    ``task_description``; an answer has ``actions`` (D,) float32, in the units of the checkpoint's data.

    Args:
        checkpoint: the folder that lerobot-train names pretrained_model, or bomb:NAME.
        device: cpu, cuda, ...; null: the checkpoint's own.
        seed: of the policy's random numbers, as --seed of lerobot-eval.
        policy: other values of its config, as the flags --policy.NAME of lerobot-eval.
        cameras: {camera of the policy: its name in the benchmark}; a camera left out has the same name.
        resize: stretch images to the size that the checkpoint reads; without it, other sizes are refused.
        observation_params: parameters for the benchmark, so that it sends what this policy reads.

    Raises:
        ValueError: the checkpoint does not exist or holds adapters, or this machine has no such device.
    """

    def __init__(
        self,
        checkpoint: str,
        device: str | None = None,
        seed: int = TEST_SEEDS[0],
        policy: dict[str, Any] | None = None,
        cameras: dict[str, str] | None = None,
        resize: bool = False,
        observation_params: dict[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self._policy = StandalonePolicy(checkpoint, device, seed, policy or {}, cameras or {}, resize)
        self._observation_params = observation_params or {}
        self._episode: SessionContext | None = None  # the one under way
        self._environment: Environment | None = None  # where it acts, if that is BOMB

    def get_observation_params(self) -> dict[str, Any]:
        return self._observation_params

    def get_action_spec(self) -> dict[str, DimSpec]:
        return {}  # an action means what it meant in the checkpoint's data, which no config says

    def get_observation_spec(self) -> dict[str, DimSpec]:
        state = {"state": RAW} if self._policy.reads_state else {}
        return {**dict.fromkeys(self._policy.cameras.values(), IMAGE_RGB), "language": LANGUAGE, **state}

    async def on_episode_start(self, config: dict[str, Any], ctx: SessionContext) -> None:
        await super().on_episode_start(config, ctx)
        if self._episode is None or self._episode.session_id == ctx.session_id:
            self._episode = ctx
            environment = config["task"].get(ENVIRONMENT)
            self._environment = None if environment is None else Environment(**json.loads(environment))

    async def on_episode_end(self, result: dict[str, Any], ctx: SessionContext) -> None:
        await super().on_episode_end(result, ctx)
        if self._episode is ctx:
            self._episode = None

    def predict(self, obs: Observation, ctx: SessionContext) -> Action:
        """Return the next action of the episode.

        Raises:
            ValueError: the observation is not what the policy reads, or the policy was trained for another
                BOMB.
            RuntimeError: another session's episode is under way.
        """
        if ctx is not self._episode:
            raise RuntimeError("this server runs another session's episode; start a server for each shard")
        if ctx.is_first:
            if self._environment is not None:
                with acting(self._policy.config):
                    check_acting_policy(self._environment)
            self._policy.begin()
        state = obs.get("states", obs.get("state"))
        if state is None and self._policy.reads_state:
            raise ValueError(
                "the checkpoint reads a state, and the benchmark sends none; many send it with "
                "observation_params: {send_state: true}"
            )
        return {"actions": self._policy.act(obs.get("images", {}), state, obs.get("task_description", ""))}
