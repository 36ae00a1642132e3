"""The noise that actions are sampled from: shared by all episodes, or an episode's own."""

import pytest
import torch

from lerobot_bomb.flow.noise import SamplingNoise

SHAPE = (16, 7)


def draws(noise: SamplingNoise, batch_sizes: list[int], times: int = 2) -> list[torch.Tensor]:
    """(episodes, times, *SHAPE): what each episode of an evaluation in such batches draws."""
    episodes = []
    for batch_size in batch_sizes:
        noise.begin()
        episodes += torch.stack([noise.draw(batch_size, SHAPE) for _ in range(times)], dim=1)
    return episodes


def test_shared_noise_is_the_same_in_every_episode_and_for_every_size_of_the_batch() -> None:
    first, *others = draws(SamplingNoise(1, is_per_episode=False), [1, 3, 2])
    assert len(others) == 5 and all(other.equal(first) for other in others)
    assert not first[0].equal(first[1])
    assert not first.equal(draws(SamplingNoise(2, is_per_episode=False), [1])[0])


def test_shared_noise_is_drawn_once_for_all_rows() -> None:
    calls = []

    def draw(shape: tuple[int, ...], generator: torch.Generator) -> torch.Tensor:
        calls.append(generator)
        return torch.zeros(shape)

    assert SamplingNoise(1, False, draw).draw(3, (2, 4)).shape == (3, 2, 4)
    assert len(calls) == 1
    SamplingNoise(1, True, draw).draw(3, (2, 4))
    assert len(calls) == 4 and len(set(map(id, calls))) == 4


def test_an_episodes_own_noise_follows_its_number_whatever_the_batches() -> None:
    singly, together, uneven = (
        draws(SamplingNoise(1, is_per_episode=True), sizes) for sizes in ([1] * 6, [6], [4, 2])
    )
    for one, other, another in zip(singly, together, uneven, strict=True):
        assert one.equal(other) and one.equal(another)
    assert len({tuple(episode.flatten().tolist()) for episode in together}) == 6
    assert not draws(SamplingNoise(2, is_per_episode=True), [1])[0].equal(singly[0])


@pytest.mark.parametrize("is_per_episode", [False, True])
def test_noise_is_standard_normal_and_independent(is_per_episode: bool) -> None:
    noise = SamplingNoise(0, is_per_episode)
    first, second = (noise.draw(2, (100, 100)) for _ in range(2))
    for values in (first[0], second[0], *([first[1]] if is_per_episode else [])):
        assert values.mean().item() == pytest.approx(0, abs=0.03)
        assert values.std().item() == pytest.approx(1, abs=0.03)
    pairs = [(first[0], second[0])] + ([(first[0], first[1])] if is_per_episode else [])
    for one, other in pairs:
        assert (one * other).mean().item() == pytest.approx(0, abs=0.03)


def test_an_episodes_noise_can_be_drawn_again() -> None:
    noise = SamplingNoise(1, is_per_episode=True)
    first, *_, fifth = draws(noise, [2, 3])
    for episode, expected in ((4, fifth), (0, first)):
        noise.begin(episode)
        assert torch.cat([noise.draw(1, SHAPE), noise.draw(1, SHAPE)]).equal(expected)
