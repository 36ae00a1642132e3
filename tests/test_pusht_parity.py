"""Relative actions on the real demonstrations: both routes show the same, and the actions come out absolute.

`lerobot-train` reads the converted demonstrations, `lerobot-eval --env.type=pusht` starts in their first
recorded states and executes their actions, which leads through the recorded states again.
"""

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_STATE
from lerobot.utils.import_utils import register_third_party_plugins
from model_inputs import Batch, first_ids, inference_inputs, pixels
from parity_routes import (
    Recorded,
    Replay,
    Route,
    Routes,
    cli_flags,
    learn_by_heart,
    resolution,
    run_train,
    tap_eval,
)
from pusht_cases import ZARR, Demonstrations, convert, starting_at
from recipes import read_recipe
from torch import Tensor

pytest.importorskip("gym_pusht")

EPISODES = range(98, 100)  # short ones, which the recorded actions lead through again to the last pixel
MIN_PSNR_DB = 35.0  # docs/pusht.md: 38 to 53; the next step's image has 32, BGR for RGB 29
MAX_DRIFT = 1e-3  # pixels of the board
LEARNED = (5, 20, 40, 90)  # frames


@pytest.fixture(scope="module")
def routes(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Routes:
    register_third_party_plugins()
    demonstrations = Demonstrations.read(shared_data / ZARR, EPISODES)
    folder = tmp_path_factory.mktemp("pusht")
    bounds = [0, *demonstrations.ends]
    recorded = Recorded(convert(demonstrations, folder), demonstrations.actions, bounds, "absolute")
    options = read_recipe("overfit", "vla0_smol")["policy"] | {"relative_actions": True}
    flags = cli_flags("vla0_smol", options, use_state=True)

    def finish(policy: PreTrainedPolicy, batches: dict[int, Batch]) -> None:
        learn_by_heart(policy, [batches[index] for index in LEARNED], half_a_bin(policy))

    training = run_train(recorded, folder / "train", flags, finish)
    checkpoint = folder / "train" / "checkpoints" / "last" / "pretrained_model"
    return Routes(recorded, training, run_pusht_eval(recorded, demonstrations, folder / "eval", checkpoint))


def half_a_bin(policy: Any) -> Tensor:
    """(D,) what a written residual may be off, in normalised actions."""
    return resolution(policy) * policy.relative.scale


def run_pusht_eval(
    recorded: Recorded, demonstrations: Demonstrations, folder: Path, checkpoint: Path
) -> Route:
    """lerobot-eval from the recorded first states, one episode after the other."""
    longest = max(np.diff(recorded.bounds))

    def run(rollout: Callable[[Any], dict], episode: int) -> tuple[dict, dict[int, Batch]]:
        start, end = recorded.bounds[episode : episode + 2]
        # the environment goes on after the demonstration's end
        held = recorded.actions[end - 1 : end].repeat(longest, axis=0)
        replay = Replay(np.concatenate([recorded.actions[start:end], held]))
        with starting_at(demonstrations.states[start]):
            result = rollout(replay)
        return result, dict(enumerate(replay.batches[: end - start], start))

    flags = f"--env.type=pusht --env.episode_length={longest} --seed=0 --eval.n_episodes={len(EPISODES)}"
    return tap_eval(checkpoint, folder, f"{flags} --eval.use_async_envs=false", run)


def test_both_routes_give_the_same_tokens_and_nearly_the_same_pixels(routes: Routes) -> None:
    psnr_db = []
    for trained, evaluated in itertools.islice(routes.frames(), 0, None, 3):
        expected = inference_inputs(routes.training.policy, trained)
        actual = inference_inputs(routes.evaluation.policy, evaluated)
        ids = first_ids(expected)
        assert ids
        for name in ids:  # the numbers of the state among them
            assert torch.equal(ids[name], first_ids(actual)[name]), f"{name}, frame {int(trained['index'])}"
        stored, drawn = (pixels(routes.training.policy, seen, 1) for seen in (expected, actual))
        errors = (stored - drawn).square().mean()
        psnr_db.append(float(10 * torch.log10((drawn.max() - drawn.min()) ** 2 / errors)))
    assert min(psnr_db) >= MIN_PSNR_DB


def test_the_environment_passes_the_recorded_states(routes: Routes) -> None:
    policy: Any = routes.training.policy
    pixels_of_one = policy.relative.gain * policy.action_unit  # of the normalised state
    for trained, evaluated in routes.frames():
        drift = (trained[OBS_STATE] - evaluated[OBS_STATE]).abs() * pixels_of_one
        assert drift.max() < MAX_DRIFT, f"frame {int(trained['index'])}"


def test_targets_are_the_recorded_actions(routes: Routes) -> None:
    """Check residuals, read with the state of evaluation: they are what was recorded, within half a bin."""
    policy: Any = routes.evaluation.policy
    actions, num_compared = routes.recorded.actions, 0
    for trained, evaluated in routes.frames():
        index = int(trained["index"])
        written = policy._targets(trained)[0].view(trained[ACTION].shape)
        residuals = policy.action_bins.decode(written)
        chunk = routes.evaluation.postprocessor(policy.relative.decode(residuals, evaluated[OBS_STATE])[0])
        steps = index + np.arange(len(chunk))
        is_pad = steps > routes.recorded.last_of_episode(index)
        assert trained["action_is_pad"][0].tolist() == is_pad.tolist()
        # one residual in 1000 is larger than what can be written
        is_end = (written[0] == 0) | (written[0] == policy.config.n_action_bins - 1)
        errors = np.abs(chunk.numpy() - actions[steps.clip(max=len(actions) - 1)])
        compared = ~is_pad[:, None] & ~is_end.numpy()
        assert (errors <= bar_px(routes))[compared].all(), f"frame {index}"
        num_compared += compared.sum()
    assert num_compared > 0.95 * actions.size * policy.config.chunk_size


def bar_px(routes: Routes) -> np.ndarray:
    """(D,) half a bin in pixels of the board."""
    span = routes.recorded.actions.max(axis=0) - routes.recorded.actions.min(axis=0)
    return (half_a_bin(routes.evaluation.policy) * torch.from_numpy(span) / 2).numpy() + MAX_DRIFT


def test_learned_actions_come_out_absolute_wherever_the_agent_is_by_then(routes: Routes) -> None:
    """The stock evaluation's postprocessor; later actions of a chunk are relative to where it started."""
    policy: Any = routes.evaluation.policy
    for index, elsewhere in zip(LEARNED, LEARNED[1:] + LEARNED[:1], strict=True):
        policy.reset()
        for step in range(policy.config.n_action_steps):
            # the queue was filled at step 0; the agent is elsewhere afterwards
            shown = routes.evaluation.batches[elsewhere if step else index]
            action = routes.evaluation.postprocessor(policy.select_action(shown))[0].numpy()
            errors = np.abs(action - routes.recorded.actions[index + step])
            assert (errors <= bar_px(routes)).all(), f"frame {index}, step {step}"
    policy.reset()
