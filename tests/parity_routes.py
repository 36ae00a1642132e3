"""The two routes from a recorded frame to a policy: LeRobot's own commands, tapped at the hand-over.

`lerobot-train` is tapped at `update_policy`, `lerobot-eval` at `rollout`. While an episode is evaluated its
recorded actions are executed, so both routes pass the same frames.
"""

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset
from lerobot.policies import PreTrainedPolicy
from lerobot.scripts import lerobot_eval, lerobot_train
from lerobot.utils.constants import ACTION
from model_inputs import Batch, joined
from torch import Tensor, nn
from torch.optim.lr_scheduler import LambdaLR
from variants import as_flags

from lerobot_bomb.data.record import record
from lerobot_bomb.data.recording import Recording

REPO_ID = "test/parity"
SEED, EPISODES, SIZE = 5, 2, 64
ROUND_STEPS, MAX_ROUNDS, CHECK_EVERY = 200, 3, 20

type Finish = Callable[[PreTrainedPolicy, dict[int, Batch]], None]
# (rollout of a replay, seed) -> (what the rollout returned, the episode's batches by index in the dataset)
type RunEpisode = Callable[[Callable[[Any], dict], int], tuple[dict, dict[int, Batch]]]


@dataclass(frozen=True)
class Recorded:
    """A dataset's folder, its actions (N, 4), and the index of each episode's first frame, then the end."""

    root: Path
    actions: np.ndarray
    bounds: list[int]
    control_mode: str

    @classmethod
    def make(cls, root: Path, *, images: bool, control_mode: str = "relative") -> "Recorded":
        options = {"control_mode": control_mode, "image_size": SIZE, "images": images}
        record(Recording(REPO_ID, EPISODES, SEED, **options), root)
        dataset = LeRobotDataset(REPO_ID, root=root, video_backend="pyav")
        episodes = dataset.meta.episodes
        assert episodes is not None and list(episodes["bomb/seed"]) == [SEED, SEED + 1]
        actions = np.stack(dataset.hf_dataset.with_format("numpy")[ACTION])
        return cls(root, actions, [*episodes["dataset_from_index"], len(actions)], control_mode)

    def last_of_episode(self, index: int) -> int:
        return next(end for end in self.bounds if end > index) - 1

    @property
    def turning_points(self) -> list[int]:
        """The first episode's first frame, and the frames just before the fingers close and open."""
        gripper = self.actions[: self.bounds[1], 3]
        return [0, *(int(index) - 1 for index in np.flatnonzero(np.diff(gripper)))]


@dataclass
class Route:
    """A policy and what it is given: preprocessed batches of one frame, by index in the dataset."""

    policy: PreTrainedPolicy = field(init=False)
    # lerobot-eval's way from the policy's action to the environment's
    postprocessor: Callable[[Tensor], Tensor] = field(init=False)
    batches: dict[int, Batch] = field(default_factory=dict)


@dataclass(frozen=True)
class Routes:
    recorded: Recorded
    training: Route
    evaluation: Route

    def frames(self) -> Iterator[tuple[Batch, Batch]]:
        """Yield both batches of every frame that training sees, which may be all but each episode's last."""
        assert len(self.training.batches) >= len(self.recorded.actions) - EPISODES
        for index, batch in sorted(self.training.batches.items()):
            yield batch, self.evaluation.batches[index]


def cli_flags(policy_type: str, options: dict[str, Any], *, use_state: bool) -> list[str]:
    """--policy.* flags of a recipe, with the state where the policy has that choice."""
    config_class = PreTrainedConfig.get_choice_class(policy_type)
    if "use_state" in {each.name for each in fields(config_class)}:
        options = options | {"use_state": use_state}
    elif not use_state:
        pytest.skip(f"{policy_type} always reads the state")
    return as_flags(options)


def as_written(policy: PreTrainedPolicy, actions: Tensor) -> Tensor:
    """Normalised actions (..., D) as a policy has them that writes cells of a grid; else as they are."""
    grids: Any = getattr(policy, "grids", None)
    return actions if grids is None else grids.decode(grids.encode(actions))


def resolution(policy: PreTrainedPolicy) -> float:
    """Largest error of a normalised value that is learned by heart: half a bin where there are bins."""
    if hasattr(policy, "grids"):
        return 1e-3
    num_bins = getattr(policy.config, "n_action_bins", None)
    if num_bins is None:
        return 0.1
    num_gaps = num_bins if getattr(policy.config, "bin_mode", "levels") == "centers" else num_bins - 1
    return 1.0001 / num_gaps


def tolerance(policy: PreTrainedPolicy) -> float:
    """Return the tolerance of normalised actions in an episode: larger for a policy that samples.

    Such a policy has not seen all of its noise while it learned. A gripper that closes or opens a step
    early or late is off by about 2.
    """
    samples = hasattr(policy.config, "num_inference_steps")
    return 3 * resolution(policy) if samples else resolution(policy)


def learn_by_heart(policy: PreTrainedPolicy, batches: list[Batch], bar: float | Tensor) -> None:
    """Train on a few frames, as evaluation shows them, until their chunks are reproduced within the bar."""
    batch = joined(batches)
    policy.eval()  # neither crops nor masks at random
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=2e-3, weight_decay=0.0, fused=True)
    # what is trained on random noise settles at a falling rate only; most need one round
    scheduler = LambdaLR(optimizer, lambda step: min(1.0, 2 * (1 - step % ROUND_STEPS / ROUND_STEPS)))
    for step in range(1, MAX_ROUNDS * ROUND_STEPS + 1):
        loss = policy(batch)[0]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        scheduler.step()
        if step % CHECK_EVERY == 0:
            policy.reset()
            error = (policy.predict_action_chunk(batch) - as_written(policy, batch[ACTION])).abs()
            if (error <= bar)[~batch["action_is_pad"]].all():
                return
    pytest.fail(f"{len(batches)} frames were not learned by heart in {MAX_ROUNDS * ROUND_STEPS} steps")


def run_routes(recorded: Recorded, folder: Path, flags: list[str], finish: Finish | None) -> Routes:
    """Run both commands; `finish` may change the policy before lerobot-train saves it."""
    training = run_train(recorded, folder / "train", flags, finish)
    checkpoint = folder / "train" / "checkpoints" / "last" / "pretrained_model"
    return Routes(recorded, training, run_eval(recorded, folder / "eval", checkpoint))


def run_train(recorded: Recorded, output_dir: Path, flags: list[str], finish: Finish | None) -> Route:
    """lerobot-train over all frames, one a step, without updates."""
    route = Route()
    num_steps = len(recorded.actions)
    steps = iter(range(1, num_steps + 1))

    def note(metrics: Any, policy: PreTrainedPolicy, batch: Batch, *_: Any, **__: Any) -> tuple[Any, None]:
        route.policy = policy
        route.batches[int(batch["index"])] = batch
        if next(steps) == num_steps and finish is not None:
            finish(policy, route.batches)
        return metrics, None

    own = f"--dataset.repo_id={REPO_ID} --batch_size=1 --num_workers=0 --wandb.enable=false"
    own += f" --steps={num_steps} --save_freq={num_steps}"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lerobot_train, "update_policy", note)
        command = ["lerobot-train", f"--dataset.root={recorded.root}", f"--output_dir={output_dir}"]
        patch.setattr(sys, "argv", [*command, *own.split(), *flags])
        lerobot_train.main()
    return route


class Replay(nn.Module):
    """Stands in for a policy: notes the batches and runs recorded actions."""

    def __init__(self, actions: np.ndarray) -> None:
        super().__init__()
        self.actions = torch.from_numpy(actions)
        self.batches: list[Batch] = []

    def reset(self) -> None:
        self.batches.clear()

    def select_action(self, batch: Batch) -> Tensor:
        self.batches.append(batch)
        return self.actions[len(self.batches) - 1][None]


def run_eval(recorded: Recorded, output_dir: Path, checkpoint: Path) -> Route:
    """lerobot-eval on the recorded seeds."""

    def run(rollout: Callable[[Any], dict], seed: int) -> tuple[dict, dict[int, Batch]]:
        start, end = recorded.bounds[seed - SEED : seed - SEED + 2]
        replay = Replay(recorded.actions[start:end])
        result = rollout(replay)
        assert len(replay.batches) == end - start and bool(result["success"][0, -1])
        return result, dict(enumerate(replay.batches, start))

    flags = f"--env.type=bomb --env.image_size={SIZE} --seed={SEED} --eval.n_episodes={EPISODES}"
    flags += f" --env.control_mode={recorded.control_mode}"
    return tap_eval(checkpoint, output_dir, flags, run)


def tap_eval(checkpoint: Path, output_dir: Path, flags: str, run: RunEpisode) -> Route:
    """lerobot-eval, an episode at a time; `run` gets its rollout, in which a replay replaces the policy."""
    route = Route()
    rollout = lerobot_eval.rollout

    def note(
        env: Any,
        policy: PreTrainedPolicy,
        env_preprocessor: Any,
        env_postprocessor: Any,
        preprocessor: Any,
        postprocessor: Any,
        seeds: list[int],
        **_: Any,
    ) -> dict:
        def run_replay(replay: Any) -> dict:
            as_recorded: Any = lambda action: action  # noqa: E731
            return rollout(env, replay, env_preprocessor, env_postprocessor, preprocessor, as_recorded, seeds)

        route.policy, route.postprocessor = policy, postprocessor
        result, batches = run(run_replay, seeds[0])
        route.batches |= batches
        return result

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lerobot_eval, "rollout", note)
        command = ["lerobot-eval", f"--policy.path={checkpoint}", f"--output_dir={output_dir}"]
        patch.setattr(sys, "argv", [*command, "--policy.device=cpu", "--eval.batch_size=1", *flags.split()])
        lerobot_eval.main()
    return route
