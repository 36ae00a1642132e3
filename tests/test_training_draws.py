"""Draws of a training follow from the seed, the process and the number of batches before."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from pointing_cases import POINTING, with_labels
from policy_cases import CASES
from torch import Tensor, distributed

from lerobot_bomb.training.randomness import begin_batch

CROPPED = {"crop_fraction": 0.7}


class Counter:
    trained_batches = 0


def draw(config: Counter, num_batches: int) -> list[list[int]]:
    """Return the first two numbers of each batch."""
    generator, drawn = torch.Generator(), []
    for _ in range(num_batches):
        begin_batch(config, generator)
        drawn.append(torch.randint(1000, (2,), generator=generator).tolist())
    return drawn


def test_every_batch_draws_anew_and_a_count_is_all_it_takes_to_resume() -> None:
    torch.manual_seed(5)
    whole, config = draw(Counter(), 4), Counter()
    assert len({tuple(numbers) for numbers in whole}) == 4
    assert draw(config, 2) == whole[:2] and config.trained_batches == 2
    torch.rand(3)  # what else is drawn does not matter
    assert draw(config, 2) == whole[2:]
    torch.manual_seed(6)
    assert draw(Counter(), 4) != whole


def test_the_seed_comes_back_with_the_state_of_torchs_generator() -> None:
    torch.manual_seed(5)
    whole, state = draw(Counter(), 1), torch.get_rng_state()
    torch.manual_seed(6)
    torch.set_rng_state(state)
    assert draw(Counter(), 1) == whole


def test_every_process_draws_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(5)
    monkeypatch.setattr(distributed, "is_initialized", lambda: True)
    drawn = []
    for rank in range(3):
        monkeypatch.setattr(distributed, "get_rank", lambda rank=rank: rank)
        drawn.append(draw(Counter(), 1))
    assert drawn[0] != drawn[1] != drawn[2] != drawn[0]


@pytest.fixture
def losses(policy_type: str) -> Callable[..., list[Tensor]]:
    """losses(then): of three batches, all alike; ``then`` is called after each."""
    cases = CASES[policy_type]

    def run(then: Callable[[Any, Any], object]) -> list[Tensor]:
        policy = cases.make_policy(**CROPPED)
        batch = cases.make_batch(policy, 2)
        made = []
        for _ in range(3):
            made.append(policy.train()(batch)[0].detach())
            then(policy, batch)
        return made

    return run


def test_what_happens_between_batches_does_not_change_them(losses: Callable[..., list[Tensor]]) -> None:
    def evaluate(policy: Any, batch: Any) -> None:
        policy.eval()(batch)
        policy.predict_action_chunk(batch)
        torch.rand(1)

    usual = losses(lambda policy, batch: None)
    assert len(set(map(float, usual))) == 3
    assert torch.equal(torch.stack(losses(evaluate)), torch.stack(usual))


@torch.no_grad()
def test_a_frames_evaluation_does_not_depend_on_others(policy_type: str) -> None:
    cases = CASES[policy_type]
    policy = cases.make_policy(**POINTING[policy_type], **CROPPED).eval()
    batch = with_labels(cases.make_batch(policy, 4))
    loss, metrics = policy(batch)
    assert policy(batch)[0].equal(loss)
    policy.config.counterfactual_share = 0.0
    again, same = policy(batch)
    assert again.equal(loss) and same == metrics
