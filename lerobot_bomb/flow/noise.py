"""Noise that actions are sampled from: one sequence for all episodes, or one for each."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor


class SamplingNoise:
    """Noise for the queries of a batch of episodes, which ``begin`` starts.

    Args:
        seed: of the sequence that all episodes share; with an episode's number, of its own sequence.
        is_per_episode: whether each episode has a sequence of its own. The episode's number counts the rows
            of all batches before it, so in an evaluation it depends on neither batch size nor row.
        draw: function of a shape and a ``generator``; by default of N(0, I).
    """

    def __init__(self, seed: int, is_per_episode: bool, draw: Callable[..., Tensor] = torch.randn) -> None:
        self._seed, self._is_per_episode, self._draw = seed, is_per_episode, draw
        self._first_episode = 0
        self._generators: list[torch.Generator] = []  # of each row; of all, if they share one

    def begin(self, first_episode: int | None = None) -> None:
        """Begin episodes in the rows of the next batch, of these numbers on; None: those that come next."""
        if first_episode is None:
            first_episode = self._first_episode + len(self._generators)
        self._first_episode = first_episode
        self._generators = []

    def draw(self, batch_size: int, shape: tuple[int, ...]) -> Tensor:
        """Draw (B, *shape) float32 on the CPU. Rows may share memory, so do not write to them."""
        num_sequences = batch_size if self._is_per_episode else 1
        for row in range(len(self._generators), num_sequences):
            self._generators.append(torch.Generator().manual_seed(self._seed_of(row)))
        noises = [self._draw(shape, generator=generator) for generator in self._generators[:num_sequences]]
        return torch.stack(noises).expand(batch_size, *shape)

    def _seed_of(self, row: int) -> int:
        if not self._is_per_episode:
            return self._seed
        words = np.random.SeedSequence((self._seed, self._first_episode + row))
        return int(words.generate_state(1, np.uint64)[0])


def gumbel(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    """Draw standard Gumbel noise: with it added, a logit is the largest with its softmax probability."""
    return -torch.empty(shape).exponential_(generator=generator).log()
