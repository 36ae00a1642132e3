"""Replay of a record's episode, by the policy that ran it then."""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium

from lerobot_bomb.bomb.observation import RenderOptions
from lerobot_bomb.envs.results import PolicyIdentity, ResultLine, Row
from lerobot_bomb.envs.rollout import Agent, BatchAgent, one_of_batch
from lerobot_bomb.evaluation.bomb_lines import spec_of
from lerobot_bomb.evaluation.result_lines import kind_of
from lerobot_bomb.pusht.episode import PushTSpec
from lerobot_bomb.viewing.episode import Player, Viewed, bomb_episode, pusht_episode

MAX_BATCH = 1000  # environments at once


@dataclass(frozen=True)
class Replay:
    """A record, and what it does not say of the policy that ran it."""

    row: Row
    policy_path: Path | None = None  # where the checkpoint lies now; None: where it lay then
    policy_device: str | None = None  # None: the checkpoint's own
    policy_flags: Sequence[str] = ()  # of the evaluation: "--n_action_steps=4"
    depth: bool = False  # whether the policy was shown depth

    def player(self, perturbations: str | None = None) -> Player:
        """Run the record's episode; under other perturbations, that of the same seed.

        Raises:
            ValueError: its environment has no recording for Rerun, its batch cannot be run again, or, once
                it runs, the policy is not that of the record or cannot be had.
        """
        row, size = self._place
        if size > MAX_BATCH or row >= size or row > self.row["spec"]["seed"]:
            raise ValueError(
                f"the line says policy.batch_row={row} of policy.batch_size={size}, and replay plays the "
                f"others of its batch along: at most {MAX_BATCH}, of seeds from 0 on"
            )
        viewed = self.viewed(perturbations)
        return Player(viewed, partial(self._agent, viewed))

    @property
    def checkpoint(self) -> Path | None:
        """Return the folder of the policy that ran; None: the record names none."""
        path = (self.row.get("policy") or {}).get("path")
        return self.policy_path or (Path(path) if path else None)

    def viewed(self, perturbations: str | None = None, seed: int | None = None) -> Viewed:
        """Return the record's episode; under other perturbations or of another seed.

        Raises:
            ValueError: its environment has no recording for Rerun.
        """
        row = self.row
        changed = {
            "perturbations": perturbations or row["spec"]["perturbations"],
            "seed": row["spec"]["seed"] if seed is None else seed,
        }
        match kind_of(row).env_type:
            case "bomb":
                preset = row.get("render_preset", RenderOptions.preset)
                options = RenderOptions(row["image_size"], preset, self.depth)
                return bomb_episode(replace(spec_of(row), **changed), options)
            case "bomb_pusht":
                spec = PushTSpec(**row["spec"] | changed)
                return pusht_episode(spec, row["image_size"])
            case env_type:
                flags = " ".join(kind_of(row).eval_flags([row]))
                raise ValueError(
                    f"--env.type={env_type} has no recording for Rerun; lerobot-eval plays the episode: "
                    f"{flags} --seed={row['spec']['seed']} --eval.n_episodes=1 --eval.batch_size=1"
                )

    @contextmanager
    def _agent(self, viewed: Viewed, _: gymnasium.Env) -> Iterator[Agent]:
        agents = one_of_batch(self._batch_agent(viewed), viewed.make_env, viewed.spec.seed, *self._place)
        with agents as agent:
            yield agent

    @property
    def _place(self) -> tuple[int, int]:
        """Return the record's row in its batch, and how many rows that had."""
        policy = self.row.get("policy") or {}
        return policy.get("batch_row") or 0, policy.get("batch_size") or 1

    def _batch_agent(self, viewed: Viewed) -> BatchAgent:
        from lerobot_bomb.checkpoints.identity import identity_of
        from lerobot_bomb.compat.hooks.policies import built_policies  # LeRobot and torch: seconds
        from lerobot_bomb.viewing.checkpoint import checkpoint_agent, scripted_agent

        # who played is not asked whether it was trained for this
        env = viewed.env_type, viewed.env_flags | {"ignore_checkpoint": True}, viewed.spec.seed
        policy = self.row.get("policy") or {}
        path = self.checkpoint
        if path is None and policy:
            return scripted_agent(policy["type"], *env)
        if path is None:
            raise ValueError("the line does not say who played; name it with --policy.path=FOLDER")
        agent = checkpoint_agent(path, self.policy_device, *env, self.policy_flags)
        if viewed.spec.perturbations == self.row["spec"]["perturbations"]:
            _check_policy(policy, path, identity_of(built_policies()[-1]))
        return agent


def line_of(result: ResultLine) -> Row:
    """Return a result as its record is read back."""
    return json.loads(result.to_json())


def _check_policy(played: dict[str, Any], path: Path, loaded: PolicyIdentity) -> None:
    """Raise a ValueError if the loaded policy is another than the one that ran then."""
    if played.get("weights_sha256") not in (None, loaded.weights_sha256):
        raise ValueError(
            f"{path} holds other weights than those that played; name the folder that holds them with "
            "--policy.path=FOLDER, or see what these do with `lerobot-bomb view`"
        )
    if played.get("settings_sha256") not in (None, loaded.settings_sha256):
        raise ValueError(
            f"{path} holds the weights that played, but other settings; give the flags --policy.NAME=VALUE "
            "of that evaluation"
        )
