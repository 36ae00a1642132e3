"""A policy gets the same inputs in training and in evaluation, and its actions come out as recorded."""

import functools
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import ACTION
from lerobot.utils.import_utils import register_third_party_plugins
from model_inputs import Batch, first_ids, inference_inputs, pixels, probes, repeated
from parity_routes import (
    Recorded,
    Routes,
    as_written,
    cli_flags,
    learn_by_heart,
    resolution,
    run_routes,
    tolerance,
)
from variants import DENOISE_ONLY, Options, small_policy

# Least PSNR of a camera's pixels, as the network gets them, between a frame out of a video and the drawn one.
# Measured: AV1 at 64x64 gives at least 26.8 dB; swapped cameras gave 10.7, BGR for RGB 8.7, a video that is
# one frame late 13.3.
MIN_PSNR_DB = 22.0
VIEWS_PER_BATCH, MAX_VIEW_BATCHES = 32, 8

MakeRoutes = Callable[..., Routes]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Callable[[bool, str], Recorded]:
    @functools.cache
    def make(images: bool, control_mode: str) -> Recorded:
        root = tmp_path_factory.mktemp("recorded") / "dataset"
        return Recorded.make(root, images=images, control_mode=control_mode)

    return make


@pytest.fixture(scope="module")
def cache() -> dict[tuple, Routes]:
    return {}


@pytest.fixture
def routes(
    policy_type: str,
    recorded: Callable[[bool, str], Recorded],
    cache: dict[tuple, Routes],
    tmp_path: Path,
) -> MakeRoutes:
    """routes(options, images, use_state, control_mode): both routes of the policy, run once per module."""

    def make(
        options: Options | None = None,
        images: bool = True,
        use_state: bool = True,
        control_mode: str = "relative",
    ) -> Routes:
        key = (policy_type, str(options or {}), images, use_state, control_mode)
        if key not in cache:
            register_third_party_plugins()
            own = small_policy(policy_type) | (options or {})
            flags = cli_flags(policy_type, own, use_state=use_state)
            data = recorded(images, control_mode)
            learns = images and use_state

            def finish(policy: PreTrainedPolicy, batches: dict[int, Batch]) -> None:
                chosen = [batches[index] for index in data.turning_points]
                learn_by_heart(policy, chosen, resolution(policy))

            cache[key] = run_routes(data, tmp_path, flags, finish if learns else None)
        return cache[key]

    return make


def require_same_inputs(both: Routes) -> None:
    for trained, evaluated in both.frames():
        expected = inference_inputs(both.training.policy, trained)
        actual = inference_inputs(both.evaluation.policy, evaluated)
        assert expected.keys() == actual.keys()
        for name, calls in expected.items():
            assert all(map(torch.equal, calls, actual[name])), f"{name}, frame {int(trained['index'])}"


@pytest.mark.one_type
def test_images_give_exactly_the_same_inputs(routes: MakeRoutes, options: Options) -> None:
    require_same_inputs(routes(options))


@pytest.mark.one_type
def test_images_give_exactly_the_same_inputs_without_state(routes: MakeRoutes) -> None:
    require_same_inputs(routes(use_state=False))


@pytest.mark.one_type
def test_video_gives_the_same_tokens_and_nearly_the_same_pixels(routes: MakeRoutes) -> None:
    both = routes(images=False)
    psnr_db = []
    for trained, evaluated in both.frames():
        expected = inference_inputs(both.training.policy, trained)
        actual = inference_inputs(both.evaluation.policy, evaluated)
        for name, ids in first_ids(expected).items():
            assert torch.equal(ids, first_ids(actual)[name]), f"{name}, frame {int(trained['index'])}"
        stored, drawn = pixels(both.training.policy, expected, 1), pixels(both.evaluation.policy, actual, 1)
        errors = (stored - drawn).square().mean(dim=1)
        psnr_db.append(10 * torch.log10((drawn.max() - drawn.min()) ** 2 / errors))
    assert torch.cat(psnr_db).min() > MIN_PSNR_DB


def test_evaluation_is_one_of_the_views_of_training(routes: MakeRoutes, options: Options) -> None:
    both = routes(options)
    trained, evaluated = next(both.frames())
    alone = inference_inputs(both.evaluation.policy, evaluated)
    together = inference_inputs(both.evaluation.policy, repeated(evaluated, VIEWS_PER_BATCH))
    views = pixels(both.evaluation.policy, alone, 1)
    images = pixels(both.evaluation.policy, together, VIEWS_PER_BATCH)
    # the place of each camera's images in a batch
    places = [(images == view).all(dim=1) for view in views]
    assert (torch.stack(places).sum(dim=0) == 1).all()

    policy = both.training.policy.train()
    found = [False] * len(views)
    for _ in range(MAX_VIEW_BATCHES):
        with torch.no_grad(), probes(policy) as seen:
            policy(repeated(trained, VIEWS_PER_BATCH))
        for name, ids in first_ids(alone).items():
            assert torch.equal(seen[name][0][0][: len(ids[0])], ids[0]), f"{name}: training begins otherwise"
        crops = pixels(policy, seen, VIEWS_PER_BATCH)
        for camera, (view, place) in enumerate(zip(views, places, strict=True)):
            found[camera] |= bool((crops[place] == view).all(dim=1).any())
        if all(found):
            return
    pytest.fail(f"training never shows what evaluation shows; by camera: {found}")


def test_targets_are_the_actions_from_the_frame_on(routes: MakeRoutes, options: Options) -> None:
    both = routes(options)
    for index, batch in both.training.batches.items():
        chunk = both.evaluation.postprocessor(batch[ACTION])[0].numpy()
        last = both.recorded.last_of_episode(index)
        steps = index + np.arange(len(chunk))
        np.testing.assert_allclose(chunk, both.recorded.actions[steps.clip(max=last)], atol=1e-5)
        assert batch["action_is_pad"][0].tolist() == (steps > last).tolist()


def require_recorded_actions(both: Routes) -> None:
    """Require that each action of a policy that learned the turning points is what was recorded."""
    policy, actions = both.evaluation.policy, recorded_as_written(both)
    bar = tolerance(policy) * (actions.max(axis=0) - actions.min(axis=0)) / 2
    for shown in both.recorded.turning_points, both.recorded.turning_points[::-1]:
        policy.reset()
        for step, (index, expected) in enumerate(expected_actions(policy.config, shown, actions)):
            selected = policy.select_action(both.evaluation.batches[index])
            action = both.evaluation.postprocessor(selected)[0].numpy()
            assert (np.abs(action - expected) <= bar).all(), f"frame {index}, step {step}"
    policy.reset()


def recorded_as_written(both: Routes) -> np.ndarray:
    """(N, D) recorded actions; of a policy with grids, what their cells stand for."""
    policy, actions = both.evaluation.policy, both.recorded.actions
    if not hasattr(policy, "grids"):
        return actions
    actions = actions.copy()
    for index, batch in both.training.batches.items():
        for step in (~batch["action_is_pad"][0]).nonzero()[:, 0].tolist():
            written = as_written(policy, batch[ACTION][:, step])
            actions[index + step] = both.evaluation.postprocessor(written)[0].numpy()
    return actions


def expected_actions(
    config: PreTrainedConfig, shown: list[int], actions: np.ndarray
) -> Iterator[tuple[int, np.ndarray]]:
    """Frames that are shown one after the other, and the action that must follow each.

    A queue is filled by a frame and emptied whatever is shown then. An ensemble takes the mean of what the
    last frames foresaw for this step, and as they are from different moments, it is far from each of them.
    """
    num_chunks = getattr(config, "temporal_ensemble_size", 0)
    num_steps = getattr(config, "n_action_steps")  # noqa: B009  a field of every policy's own config
    if not num_chunks:
        for index in shown:
            for step in range(num_steps):
                yield index, actions[index + step]
        return
    for last, index in enumerate([*shown, shown[0]]):
        newest_first = [*shown, shown[0]][last::-1][:num_chunks]
        yield index, np.mean([actions[i + age] for age, i in enumerate(newest_first)], axis=0)


def require_predicted_actions(both: Routes) -> None:
    """Require that each action is what the policy that was trained foresaw for the frame."""
    trained, policy = both.training.policy.eval(), both.evaluation.policy
    num_steps = getattr(policy.config, "n_action_steps")  # noqa: B009  a field of every policy's own config
    trained.reset()
    policy.reset()
    for index in both.recorded.turning_points:
        foreseen = both.evaluation.postprocessor(trained.predict_action_chunk(both.training.batches[index]))[
            0
        ]
        for step in range(num_steps):
            selected = policy.select_action(both.evaluation.batches[index])
            action = both.evaluation.postprocessor(selected)[0]
            torch.testing.assert_close(
                action, foreseen[step], atol=1e-4, rtol=0, msg=f"frame {index}, {step}"
            )
    policy.reset()


def test_learned_actions_reach_the_environment_in_their_order(routes: MakeRoutes, options: Options) -> None:
    both = routes(options)
    if options == DENOISE_ONLY:  # one noise in six leads to another frame's action after 1500 steps, too
        require_predicted_actions(both)
    else:
        require_recorded_actions(both)


@pytest.mark.long
def test_learned_absolute_actions_reach_the_environment_in_their_order(routes: MakeRoutes) -> None:
    require_recorded_actions(routes(control_mode="absolute"))
