"""The noise that actions are sampled from: one sequence for all episodes, or an episode's own."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor


class SamplingNoise:
    """Noise that is drawn again and again between one ``begin`` of episodes and the next.

    Args:
        seed: of the sequence that all episodes share, and with an episode's number of its own.
        is_per_episode: whether each episode has a sequence of its own. Its number counts the rows of all
            batches before it, so in an evaluation it depends on neither the size of the batch nor the row.
        draw: of N(0, I) unless given; takes a shape and a ``generator``.
    """

    def __init__(self, seed: int, is_per_episode: bool, draw: Callable[..., Tensor] = torch.randn) -> None:
        self._seed, self._is_per_episode, self._draw = seed, is_per_episode, draw
        self._first_episode = 0
        self._generators: list[torch.Generator] = []  # of each row; of all, if they share one

    def begin(self) -> None:
        """Begin new episodes in the rows of the next batch."""
        self._first_episode += len(self._generators)
        self._generators = []

    def draw(self, batch_size: int, shape: tuple[int, ...]) -> Tensor:
        """(B, *shape) float32 on the CPU. Rows may share memory: not to be written to."""
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
    """Noise of the standard Gumbel distribution: a logit's share in which it is largest is its softmax."""
    return -torch.empty(shape).exponential_(generator=generator).log()
