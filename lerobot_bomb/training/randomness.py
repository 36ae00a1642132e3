"""Randomness in training, as a function of the seed, the process and the number of batches before.

LeRobot saves the state of torch's generator, but a resumed training cannot draw from that alone: starting to
read the data draws from it once more, and every process gets the state of the first.
"""

from typing import Protocol

import numpy as np
import torch

from lerobot_bomb.training.distributed import process_number


class CountsBatches(Protocol):
    """Config that counts the batches trained on."""

    trained_batches: int


def begin_batch(config: CountsBatches, generator: torch.Generator) -> None:
    """Seed ``generator`` for the next batch of a training, and count it."""
    # a resumed training's seed is that of the first one: it is part of the generator's state
    words = np.random.SeedSequence([torch.initial_seed(), process_number(), config.trained_batches])
    generator.manual_seed(int(words.generate_state(1, np.uint64)[0]))
    config.trained_batches += 1
