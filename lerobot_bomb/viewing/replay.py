"""Replay of a record's episode, by the policy that ran it then."""

import shlex
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium

from lerobot_bomb.checkpoints.shipped import checkpoint_path
from lerobot_bomb.environments import env_type
from lerobot_bomb.envs.rollout import Agent, BatchAgent, one_of_batch
from lerobot_bomb.results.names import shipped_name
from lerobot_bomb.results.origin import PolicyIdentity
from lerobot_bomb.results.record import Record
from lerobot_bomb.viewing.episode import Viewed, ViewedRun

MAX_BATCH = 1000  # environments at once


@dataclass(frozen=True)
class Replay:
    """A record, with the flags of its policy that it does not hold."""

    record: Record
    policy_path: Path | None = None  # where the checkpoint lies now; None: where it lay then
    policy_device: str | None = None  # None: the checkpoint's own
    policy_flags: Sequence[str] = ()  # of the evaluation: "--n_action_steps=4"
    depth: bool = False  # whether the policy was shown depth

    def viewed_run(self, perturbations: str | None = None) -> ViewedRun:
        """Run the record's episode; under other perturbations, that of the same seed.

        Raises:
            ValueError: the environment has no recording for Rerun, the batch cannot be run again, or, once it
                runs, the policy is missing or not that of the record.
        """
        row, size = self._place
        if size > MAX_BATCH or row >= size or row > self.record.spec.seed:
            raise ValueError(
                f"the record has policy.batch_row={row} of policy.batch_size={size}, and replay runs the "
                f"whole batch: at most {MAX_BATCH}, of seeds from 0 on"
            )
        viewed = self.viewed(perturbations)
        return ViewedRun(viewed, partial(self._agent, viewed))

    @property
    def checkpoint(self) -> Path | None:
        """Return the folder of the policy that ran; None if the record names none.

        Raises:
            ValueError: the package no longer has the shipped checkpoint that ran.
        """
        path = None if self.record.policy is None else self.record.policy.path
        if self.policy_path or not path:
            return self.policy_path
        # a shipped checkpoint lies elsewhere on another machine
        return Path(checkpoint_path(shipped_name(path) or path))

    def viewed(self, perturbations: str | None = None, seed: int | None = None) -> Viewed:
        """Return the record's episode; under other perturbations or of another seed.

        Raises:
            ValueError: its environment has no recording for Rerun.
        """
        record = self.record
        changed: dict[str, Any] = {
            "perturbations": perturbations or record.spec.perturbations,
            "seed": record.spec.seed if seed is None else seed,
        }
        env = env_type(record.env_type)
        if not env.view_at:
            flags = [] if record.policy is None else [record.policy.flag]
            flags += [*record.eval_flags([record]), *record.condition_flags([record.spec.perturbations])]
            flags += [f"--seed={record.spec.seed}", "--eval.n_episodes=1", "--eval.batch_size=1"]
            flags += ["--eval.use_async_envs=false"]
            raise ValueError(
                f"--env.type={record.env_type} has no recording for Rerun; for a video of the episode: "
                f"{shlex.join(['lerobot-eval', *flags])}"
            )
        spec: Any = record.spec
        viewed: Viewed = env.view.of_record(record, replace(spec, **changed), self.depth)
        # the record's policy ran here, whatever it was trained for
        return replace(viewed, env_flags=viewed.env_flags | {"ignore_checkpoint": True})

    @contextmanager
    def _agent(self, viewed: Viewed, _: gymnasium.Env) -> Iterator[Agent]:
        with self._threads():
            agents = one_of_batch(self._batch_agent(viewed), viewed.make_env, viewed.spec.seed, *self._place)
            with agents as agent:
                yield agent

    def _threads(self) -> AbstractContextManager[None]:
        if self.record.inference is None:
            return nullcontext()
        from lerobot_bomb.checkpoints.queries import threads_of  # LeRobot and torch: seconds

        return threads_of(self.record.inference.device)

    @property
    def _place(self) -> tuple[int, int]:
        """Return the record's row in its batch, and how many rows that had."""
        policy = self.record.policy
        return (0, 1) if policy is None else (policy.batch_row or 0, policy.batch_size or 1)

    def _first_episode(self, seed: int) -> int:
        """Return the number of the batch's first episode in its evaluation of one task; 0 if unknown."""
        evaluation = self.record.evaluation
        if evaluation is None or evaluation.seed is None:
            return 0
        return max(0, seed - self._place[0] - evaluation.seed)

    def _batch_agent(self, viewed: Viewed) -> BatchAgent:
        from lerobot_bomb.checkpoints.identity import identity_of  # LeRobot and torch: seconds
        from lerobot_bomb.viewing.checkpoint import load_policy, scripted_agent

        env = viewed.env_type, viewed.env_flags, viewed.spec.seed
        policy, path = self.record.policy, self.checkpoint
        if path is None and policy is not None:
            return scripted_agent(policy.type, *env)
        if path is None:
            raise ValueError("the record does not name its policy; give --policy.path=FOLDER")
        loaded = load_policy(path, self.policy_device, *env, self.policy_flags)
        if policy is not None and viewed.spec.perturbations == self.record.spec.perturbations:
            _check_policy(policy, path, identity_of(loaded.policy))
        loaded.begin(self._first_episode(viewed.spec.seed))
        return loaded.agent


def _check_policy(recorded: PolicyIdentity, path: Path, loaded: PolicyIdentity) -> None:
    """Raise a ValueError if the loaded policy is another than the one that ran then."""
    if recorded.weights_sha256 not in (None, loaded.weights_sha256):
        raise ValueError(
            f"{path} holds other weights than those of the record; name the folder that holds them with "
            "--policy.path=FOLDER, or see what these do with `lerobot-bomb view`"
        )
    if recorded.settings_sha256 not in (None, loaded.settings_sha256):
        raise ValueError(
            f"{path} holds the record's weights, but other settings; give the flags --policy.NAME=VALUE "
            "of that evaluation"
        )
